"""The transport `iceoryx2` beyond the contract: nothing is left behind, runs do not meet, and no piece is lost."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import PortInUse, RequestFailed, S2AError, ServerDied, TransportError, UsageError
from s2a_bench.frames.convert import to_bgr, to_rgb
from s2a_bench.machine.doctor import Machine
from s2a_bench.testing.transport import Connect, RecordingHandler, ask, connector, served, wiring_of, yuyv_frame
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, open_client, open_server, serving
from s2a_bench.transport.limits import Limits
from s2a_bench.types import Frame, Request, Token
from tests.waiting import until

iceoryx2 = pytest.importorskip("iceoryx2")
from s2a_bench.plugins.iceoryx2 import check  # noqa: E402
from s2a_bench.plugins.iceoryx2 import wire as room  # noqa: E402
from s2a_bench.plugins.iceoryx2.wire import SLICE, UNREAD, Domain, bytes_in, packed, unpacked  # noqa: E402

SPAWN = get_context("spawn")
WIRING = wiring_of("iceoryx2")


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of this user's nodes for this test alone, after which nothing may be left in shared memory."""
    with TemporaryDirectory() as short:
        monkeypatch.setenv("XDG_RUNTIME_DIR", short)
        own, memory = Path(short) / f"s2a_bench-{os.getuid()}", room.MEMORY
        yield own
    assert sorted(path.name for path in memory.glob(f"{room.prefix_of(own)}*")) == []


@pytest.fixture
def connect() -> Iterator[Connect]:
    yield from connector(WIRING)


def words(number: int = 10**9, pause_s: float = 0.0) -> Handler:
    def handle(request: Request, trace: Trace) -> Generator[Token, None, None]:  # noqa: ARG001
        trace.mark("inference")
        for index in range(number):
            yield Token(index, "go ")
            time.sleep(pause_s)

    return handle


@pytest.mark.parametrize("payload", ["raw", "png"])
def test_several_pictures_of_unlike_sizes_arrive_with_their_very_pixels(payload: str) -> None:
    handler = RecordingHandler(["x"])
    frames = tuple(yuyv_frame(width, height, seed) for seed, (width, height) in enumerate([(64, 48), (2, 2), (98, 30)]))
    for connect in connector(wiring_of(f"iceoryx2?payload={payload}")):
        ask(connect(handler), Request("a", "plan", frames))
    (got,) = handler.requests
    assert len(got.images) == 3
    for image, frame in zip(got.images, frames, strict=True):
        np.testing.assert_array_equal(image.data, to_rgb(frame))


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8"])
def test_a_camera_of_rgb_or_bgr_is_written_once(connect: Connect, encoding: Any) -> None:
    handler = RecordingHandler(["x"])
    frame = Frame(0, now_ns(), 64, 48, encoding, to_bgr(yuyv_frame()))
    ask(connect(handler), Request("a", "plan", (frame,)))
    np.testing.assert_array_equal(handler.requests[0].images[0].data, to_rgb(frame))


def test_larger_pictures_and_smaller_ones_follow_each_other(connect: Connect) -> None:
    handler = RecordingHandler(["x"] * 40)
    client = connect(handler)
    for width in (64, 1920, 1920, 64, 3840, 64):
        assert len(ask(client, Request("a", "plan", (yuyv_frame(width, width // 2),)))[0]) == 40
        np.testing.assert_array_equal(handler.requests[-1].images[0].data, to_rgb(yuyv_frame(width, width // 2)))


def test_no_piece_is_lost_where_the_client_is_slower_than_the_slices_are_many() -> None:
    number = 200 * UNREAD
    with (
        served(WIRING, words(number)) as (server, _),
        closing(open_client(replace(WIRING, address=server.address))) as client,
    ):
        pieces = client.request(Request("a", "go", max_tokens=number), Trace())
        first = next(pieces)
        time.sleep(0.2)
        assert [first.index, *(piece.index for piece in pieces)] == [*range(number)]


def test_a_stream_is_cut_anywhere() -> None:
    parts = [Token(0, "a", 3), Token(1, "ö\n" * 50, -1), "it broke"]
    whole = b"".join(packed(part) for part in parts)
    stream, got = bytearray(), []
    for byte in whole:
        stream.append(byte)
        got += unpacked(stream)
    assert got == parts
    assert not stream


def test_a_failed_conversion_gives_its_slice_back(connect: Connect) -> None:
    client = connect(RecordingHandler(["x"]))
    failures = []
    for _ in range(10):
        with pytest.raises(ValueError, match="pixels should be") as failed:
            ask(client, Request("a", "plan", (replace(yuyv_frame(), data=np.zeros(7, np.uint8)),)))
        failures.append(failed)  # and with it the frames of its traceback
    assert len(ask(client, Request("b", "plan", (yuyv_frame(),)))[0]) == 1
    del failed
    failures.clear()
    gc.collect()  # an exception and its frames are a cycle, which holds the port


def test_failed_answers_leave_the_client_usable(connect: Connect) -> None:
    handler = RecordingHandler(["x", "y"])
    client = connect(handler)
    handler.fail_at = 1
    failures = []
    for _ in range(10):
        with pytest.raises(RequestFailed, match="the engine has had enough") as failed:
            ask(client, Request("a", "plan", (yuyv_frame(),)))
        failures.append(failed)
    handler.fail_at = None
    assert len(ask(client, Request("b", "plan"))[0]) == 2


def test_a_stream_that_keeps_coming_ends_at_the_deadline() -> None:
    wiring = replace(WIRING, deadline_s=0.3)
    with (
        served(wiring, words(pause_s=0.001)) as (server, _),
        closing(open_client(replace(wiring, address=server.address))) as client,
    ):
        with pytest.raises(RequestFailed, match=r"did not end its answer within 0\.3 s"):
            ask(client, Request("a", "for ever", max_tokens=60_000))
        assert next(client.request(Request("b", "again"), Trace())).text == "go "


def test_silence_ends_a_request() -> None:
    release = Event()

    def silent(request: Request, trace: Trace) -> Generator[Token, None, None]:  # noqa: ARG001
        release.wait(30)
        yield Token(0, "late")

    wiring = replace(WIRING, timeout_s=0.3)
    with served(wiring, silent) as (server, _), closing(open_client(replace(wiring, address=server.address))) as client:
        with pytest.raises(RequestFailed, match=r"nothing came from \S+ for 0\.3 s"):
            ask(client, Request("a", "go"))
        release.set()


def test_a_client_that_is_closed_by_another_thread_fails_in_one_line() -> None:
    with served(WIRING, words(pause_s=0.05)) as (server, _):
        client = open_client(replace(WIRING, address=server.address))
        errors: list[Exception] = []

        def go_on() -> None:
            try:
                ask(client, Request("a", "for ever", max_tokens=60_000))
            except Exception as error:  # noqa: BLE001 - which is the test
                errors.append(error)

        thread = Thread(target=go_on)
        thread.start()
        time.sleep(0.2)
        client.close()
        thread.join(10)
        assert [type(error) for error in errors] == [RequestFailed]
        assert "this client was closed" in str(errors[0])
        with pytest.raises(RequestFailed, match="is closed"):
            ask(client, Request("b", "go"))
        errors.clear()
    Domain().leave()  # of what was in use when the client was closed, the counter of nodes stays until the next end


def test_without_a_server_it_says_so() -> None:
    with pytest.raises(ServerDied, match="no server has the iceoryx2 service nowhere"):
        open_client(wiring_of("iceoryx2", "nowhere"))


def test_a_name_is_one_servers_and_free_when_it_ends() -> None:
    wiring = wiring_of("iceoryx2", "robot")
    with served(wiring, RecordingHandler(["x"])):
        with pytest.raises(PortInUse, match="`service`: another server has the name robot"):
            open_server(wiring, RecordingHandler([]))
        with closing(open_client(wiring)) as client:
            assert len(ask(client, Request("a", "go"))[0]) == 1
    with served(wiring, RecordingHandler(["x", "y"])), closing(open_client(wiring)) as client:
        assert len(ask(client, Request("a", "go"))[0]) == 2


def test_a_server_may_come_again_while_a_client_of_the_first_is_there() -> None:
    wiring = wiring_of("iceoryx2", "robot")
    with served(wiring, RecordingHandler(["x"])):
        client = open_client(wiring)
        ask(client, Request("a", "go"))
    with closing(client), served(wiring, RecordingHandler(["x", "y"])):
        assert len(ask(client, Request("a", "go"))[0]) == 2


@pytest.mark.parametrize("name", ["a b", "x" * 81, "ä"])
def test_a_name_that_cannot_be_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="service"):
        wiring_of("iceoryx2", service=name)


def test_two_servers_do_not_meet() -> None:
    with (
        served(WIRING, RecordingHandler(["one"])) as (first, _),
        served(WIRING, RecordingHandler(["two"])) as (second, _),
    ):
        for server, text in ((first, "one"), (second, "two")):
            with closing(open_client(replace(WIRING, address=server.address))) as client:
                assert [piece.text for piece in ask(client, Request("a", "go"))[0]] == [text]


def test_a_client_too_many_is_told_so() -> None:
    wiring = replace(WIRING, limits=Limits(connections=2))
    with served(wiring, RecordingHandler(["x"])) as (server, _):
        bound = replace(wiring, address=server.address)
        clients = [open_client(bound), open_client(bound)]
        for _ in range(3):
            with pytest.raises(RequestFailed, match="takes no further client"):
                open_client(bound)
        for client in clients:
            assert len(ask(client, Request("a", "go"))[0]) == 1
            client.close()
        with closing(open_client(bound)) as client:
            assert len(ask(client, Request("a", "go"))[0]) == 1


def test_more_clients_come_and_go_than_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.plugins.iceoryx2.server.CLIENTS", 3)
    with served(WIRING, RecordingHandler(["x"])) as (server, _):
        for _ in range(12):
            with closing(open_client(replace(WIRING, address=server.address))) as client:
                assert len(ask(client, Request("a", "go", (yuyv_frame(),)))[0]) == 1


class Foreign:
    """A server below ours: it answers a request with these slices."""

    def __init__(self, *slices: Callable[[int], bytes]) -> None:
        self.domain, self.slices = Domain(), slices
        self.wake = self.domain.event("foreign").create()
        self.listener = self.wake.listener_builder().create()
        self.server = self.domain.requests("foreign").create().server_builder().initial_max_slice_len(4096).create()
        self.thread = Thread(target=self._serve)
        self.thread.start()

    def _serve(self) -> None:
        room.wait(self.listener, 10)
        active = self.server.receive()
        _, client, number, _ = room.HEAD.unpack_from(bytes_in(active))
        notifier = self.domain.event("foreign", client).open().notifier_builder().create()
        for made in self.slices:
            body = made(number)
            lent = active.loan_slice_uninit(len(body))
            bytes_in(lent)[:] = body
            lent.assume_init().send()
            notifier.notify()

    def close(self) -> None:
        self.thread.join()
        self.wake = self.listener = self.server = None
        self.domain.leave()


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (lambda _: b"abc", "sent a malformed answer"),
        (lambda number: SLICE.pack(number, 0) + b'["token", 0', "broke off"),
        (lambda number: SLICE.pack(number, 0) + b'["token", 0, 1, 2]\n', "a line of an unknown kind"),
        (lambda number: SLICE.pack(number, 0) + b'["action", 0, ["x"]]\n', "not an array of numbers|not numbers"),
        (lambda number: SLICE.pack(number, 0) + b"{]\n", "sent a malformed answer"),
        (lambda number: SLICE.pack(number, 0) + packed("the engine has had enough"), "had enough"),
        (lambda number: SLICE.pack(number, 1) + packed(Token(1, "b")), "pieces of the answer of foreign were lost"),
        (lambda number: SLICE.pack(number + 1, 0) + packed("of another request"), "broke off: it gave the request up"),
    ],
    ids=["short", "cut", "kind", "action", "json", "error", "lost", "other"],
)
def test_what_is_no_answer_fails_the_request(body: Callable[[int], bytes], says: str) -> None:
    with (
        closing(Foreign(body)),
        closing(open_client(wiring_of("iceoryx2", "foreign"))) as client,
        pytest.raises(RequestFailed, match=says),
    ):
        ask(client, Request("a", "plan"))


def test_slices_of_an_earlier_request_are_passed_over() -> None:
    slices = [
        lambda number: SLICE.pack(number - 1, 0) + packed(Token(7, "old")),
        lambda number: SLICE.pack(number, 0) + packed(Token(0, "new")),
    ]
    with closing(Foreign(*slices)), closing(open_client(wiring_of("iceoryx2", "foreign"))) as client:
        assert next(client.request(Request("a", "plan"), Trace())) == Token(0, "new")


def test_requests_of_unlike_clients_are_told_apart() -> None:
    """iceoryx2 gives a place that one left to the next, and with it what was still on its way."""
    numbers: list[int] = []
    for _ in range(2):
        with (
            closing(Foreign(lambda number: numbers.append(number) or b"")) as foreign,  # type: ignore[func-returns-value]
            closing(open_client(wiring_of("iceoryx2", "foreign"))) as client,
            pytest.raises(RequestFailed),
        ):
            ask(client, Request("a", "plan"))
        del foreign
    assert abs(numbers[0] - numbers[1]) > 1 << 32


def test_a_server_that_was_killed_is_noticed_without_being_told() -> None:
    names = SPAWN.Queue()
    server = SPAWN.Process(target=serve_for_ever, args=(names,))
    server.start()
    with closing(open_client(wiring_of("iceoryx2", names.get(timeout=30)))) as client:
        assert len(ask(client, Request("a", "go", max_tokens=60))[0]) == 60
        server.kill()
        server.join()
        with pytest.raises(ServerDied, match="has ended"):
            ask(client, Request("b", "go"))
    Domain().leave()


@pytest.mark.parametrize(
    ("fate", "tokens"),
    [(signal.SIGKILL, 10**9), (signal.SIGSTOP, 200)],  # of a stopped one only the answer under way has to end
    ids=["killed", "stopped"],
)
def test_a_client_that_is_killed_or_stopped_holds_nobody_back(fate: signal.Signals, tokens: int) -> None:
    with served(WIRING, words(tokens, 0.001)) as (server, _):
        events = SPAWN.Queue()
        victim = SPAWN.Process(target=leave_often, args=(server.address, events))
        victim.start()
        try:
            with closing(open_client(replace(WIRING, address=server.address))) as client:
                events.get(timeout=30)
                os.kill(victim.pid or 0, fate)
                pieces = client.request(Request("b", "go", max_tokens=60_000), Trace())
                assert [next(pieces).index for _ in range(100)] == [*range(100)]
                pieces.close()
        finally:
            victim.kill()
            victim.join()


def test_a_server_that_is_stopped_keeps_no_client_beyond_its_patience() -> None:
    names = SPAWN.Queue()
    server = SPAWN.Process(target=serve_for_ever, args=(names,))
    server.start()
    with closing(open_client(wiring_of("iceoryx2", names.get(timeout=30), timeout_s=0.2))) as client:
        os.kill(server.pid or 0, signal.SIGSTOP)
        for _ in range(8):
            with pytest.raises(RequestFailed, match=r"nothing came from|earlier requests of this client"):
                ask(client, Request("a", "go"))
        server.kill()
        server.join()
    Domain().leave()


def test_a_client_in_the_place_of_one_that_left_in_mid_answer_has_its_own_answer() -> None:
    with served(WIRING, words(pause_s=0.0002)) as (server, _):
        bound = replace(WIRING, address=server.address)
        for number in range(40):
            with closing(open_client(bound)) as client:
                pieces = client.request(Request(f"{number}", "for ever", max_tokens=60_000), Trace())
                assert [next(pieces).index for _ in range(5)] == [0, 1, 2, 3, 4]
                pieces.close()


def test_a_request_that_is_none_is_dropped_and_the_next_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []  # a record of logging would keep the error, and that the request
    monkeypatch.setattr(serving._log, "error", lambda _, error: said.append(str(error)))
    with served(WIRING, RecordingHandler(["x"])) as (server, _):
        domain = Domain()
        wake = domain.event(server.address).open().notifier_builder().create()
        port = domain.requests(server.address).open().client_builder().initial_max_slice_len(4096).create()
        for body in (b"abc", room.HEAD.pack(0, 1, 2, 3) + b"{}", bytes(4096)):
            lent = port.loan_slice_uninit(len(body))
            bytes_in(lent)[:] = body
            pending = lent.assume_init().send()
            wake.notify()
            until(partial(lambda answer: not answer.is_connected, pending))
        with closing(open_client(replace(WIRING, address=server.address))) as client:
            assert len(ask(client, Request("a", "go", (yuyv_frame(),)))[0]) == 1
        del pending, lent, port, wake
        domain.leave()
    assert len(said) == 3


def test_memory_that_is_not_there_fails_before_it_is_written(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    client = connect(RecordingHandler(["x"]))
    for path, says in (
        ("/proc", r"/proc has 0 bytes free, and a request takes \d+"),
        ("/nowhere", "/nowhere cannot be used"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(room, "MEMORY", Path(path))
            with pytest.raises(TransportError, match=says):
                ask(client, Request("a", "go", (yuyv_frame(),)))
    assert len(ask(client, Request("a", "go", (yuyv_frame(),)))[0]) == 1


def test_a_path_too_long_for_sockets_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("x" * 40)))
    (tmp_path / ("x" * 40)).mkdir()
    with pytest.raises(TransportError, match="is too long a path for the sockets in it"):
        open_server(WIRING, RecordingHandler([]))


def test_a_folder_that_others_may_enter_is_refused_in_one_line(folder: Path) -> None:
    folder.mkdir(mode=0o755)
    with pytest.raises(TransportError, match=r"is not a folder of this user alone: remove it, or set XDG_RUNTIME_DIR"):
        open_server(WIRING, RecordingHandler([]))
    folder.chmod(0o700)


def test_a_link_in_place_of_the_folder_is_refused(folder: Path, tmp_path: Path) -> None:
    folder.symlink_to(tmp_path)
    with pytest.raises(TransportError, match="is not a folder of this user alone"):
        open_server(WIRING, RecordingHandler([]))
    folder.unlink()


@pytest.mark.parametrize(
    ("installed", "cpu", "says"),
    [
        (True, "x86_64", "measures zero copy"),
        (False, "x86_64", "pip install '.[iceoryx2]'"),
        (False, "aarch64", "Rust"),
    ],
)
def test_the_doctor_says_how_to_get_it(installed: bool, cpu: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: cpu)
    finding = check(Machine(finds=lambda _: installed))
    assert says in f"{finding}"


def serve_for_ever(names: Any) -> None:
    """A server process: its address, then answers of 60 tokens."""
    server = open_server(WIRING, words(60, 0.0005))
    names.put(server.address)
    server.serve()


def leave_often(address: str, events: Any) -> None:
    """A client process that leaves ten answers early, and waits for the eleventh."""
    client = open_client(replace(WIRING, address=address))
    for _ in range(10):
        pieces = client.request(Request("a", "for ever", max_tokens=60_000), Trace())
        next(pieces)
        pieces.close()
    pieces = client.request(Request("a", "for ever", max_tokens=60_000), Trace())
    next(pieces)
    events.put("asked")
    time.sleep(60)


def ask_for_ever(address: str, events: Any) -> None:
    """A client process: the time of each request's end, until something fails, and what that was."""
    client = open_client(replace(WIRING, address=address, timeout_s=3))
    for number in count():
        try:
            ask(client, Request("a", "go", (yuyv_frame(320, 240),)))
        except S2AError as error:
            events.put(f"{type(error).__name__}: {error}")
            return
        events.put(number)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["server", "client"])
def test_after_a_kill_at_any_moment_the_next_run_starts_and_the_others_go_on(victim: str) -> None:
    with (
        served(WIRING, RecordingHandler(["still", "here"])) as (other, _),
        closing(open_client(replace(WIRING, address=other.address))) as witness,
    ):
        for moment in range(20):
            names, events = SPAWN.Queue(), SPAWN.Queue()  # a killed process may hold the lock of its queue for ever
            server = SPAWN.Process(target=serve_for_ever, args=(names,))
            server.start()
            address = names.get(timeout=30)
            client = SPAWN.Process(target=ask_for_ever, args=(address, events))
            client.start()
            try:
                assert events.get(timeout=30) == 0
                time.sleep(moment * 0.0037)
                (server if victim == "server" else client).kill()
                if victim == "server":
                    while not isinstance(said := events.get(timeout=30), str):
                        pass
                    assert said.startswith(("RequestFailed: ", "ServerDied: "))
                else:
                    client.join()
                    with closing(open_client(replace(WIRING, address=address, timeout_s=10))) as after:
                        with suppress(RequestFailed):  # the slices of the killed one, see docs/reliability.md
                            ask(after, Request("a", "go"))
                        assert len(ask(after, Request("b", "go"))[0]) == 60
                assert len(ask(witness, Request("c", "go", (yuyv_frame(),)))[0]) == 2
            finally:
                for process in (server, client):
                    process.kill()
                    process.join()
    last = open_server(WIRING, RecordingHandler([]))
    last.stop()
    last.serve()
