"""The transport `shm` keeps the contract, and what its wire adds: nothing is left, and nobody else is let in."""

from __future__ import annotations

import os
import socket
import stat
import struct
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from threading import Barrier, Thread
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults.peers import Peer, serving
from s2a_bench.clock import now_ns
from s2a_bench.errors import PortInUse, RequestFailed, ServerDied, TransportError, UsageError
from s2a_bench.frames.convert import to_bgr, to_rgb
from s2a_bench.machine.doctor import Machine
from s2a_bench.testing.transport import Connect, RecordingHandler, ask, connector, wiring_of, yuyv_frame
from s2a_bench.trace import Remote
from s2a_bench.transport import open_client, open_server
from s2a_bench.transport.connections import Wire
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.shm import shared_memory, unix_socket
from s2a_bench.transport.shm.memory import ANSWER_BYTES, HELLO, MAGIC, PLACE, STEP_BYTES, SharedMemory, accept, offer
from s2a_bench.transport.shm.pieces import packed, unpacked
from s2a_bench.transport.shm.server import Writer
from s2a_bench.types import Action, Frame, Request, Token
from tests.hostile.peers import usage
from tests.waiting import until


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this user's sockets, for this test alone."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / f"s2a_bench-{os.getuid()}"


@pytest.fixture
def connect() -> Iterator[Connect]:
    yield from connector(wiring_of("shm"))


def memory_of(pid: int) -> list[str]:
    """Return the files that a process has in its memory."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return [parts[5] for line in lines if len(parts := line.split(maxsplit=5)) > 5]


def named_memory(*pids: int) -> list[str]:
    """Return what processes would leave in /dev/shm if they were killed now."""
    named = (Path(name) for pid in pids for name in memory_of(pid) if not name.endswith("(deleted)"))
    return [path.name for path in named if path.parts[1:3] == ("dev", "shm")]


@pytest.mark.parametrize("payload", ["raw", "png"])
def test_several_pictures_of_unlike_sizes_arrive_with_their_very_pixels(payload: str) -> None:
    handler = RecordingHandler(["x"])
    frames = tuple(yuyv_frame(width, height, seed) for seed, (width, height) in enumerate([(64, 48), (2, 2), (98, 30)]))
    for connect in connector(wiring_of(f"shm?payload={payload}")):
        ask(connect(handler), Request("a", "plan", frames))
    (got,) = handler.requests
    assert len(got.images) == 3
    for image, frame in zip(got.images, frames, strict=True):
        np.testing.assert_array_equal(image.data, to_rgb(frame))


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8"])
def test_a_camera_of_rgb_or_bgr_is_written_once(connect: Connect, encoding: Any) -> None:
    handler = RecordingHandler(["x"])
    pixels = to_bgr(yuyv_frame())
    frame = Frame(0, now_ns(), 64, 48, encoding, pixels)
    ask(connect(handler), Request("a", "plan", (frame,)))
    np.testing.assert_array_equal(handler.requests[0].images[0].data, to_rgb(frame))


def test_a_larger_picture_opens_a_link_with_more_memory_and_says_so(connect: Connect) -> None:
    handler = RecordingHandler(["x"] * 40)
    client = connect(handler)
    stages = []
    for width in (64, 1280, 1280, 64):
        _, trace = ask(client, Request("a", "plan", (yuyv_frame(width, width // 2),)))
        stages.append("connect" in [stage for stage, _ in trace.marks])
        np.testing.assert_array_equal(handler.requests[-1].images[0].data, to_rgb(yuyv_frame(width, width // 2)))
    assert stages == [False, True, False, False]


def test_a_server_that_is_killed_in_mid_answer_leaves_nothing_and_the_next_start_cleans_up(own_folder: Path) -> None:
    with serving("shm") as server:
        peer = Peer(wiring_of("shm", server.address, timeout_s=10), server.pid)
        try:
            peer.hear("ready", seconds=60)
            before = usage(peer.pid).descriptors
            peer.tell("ask")
            peer.hear("token")
            assert named_memory(server.pid, peer.pid) == []
            os.kill(server.pid, 9)
            error = peer.hear("end")["error"]  # the link may break before the process is seen as ended
            assert error in {
                f"ServerDied: the server at {server.address} has ended",
                f"RequestFailed: {server.address} broke off: it closed the link",
            }
            assert usage(peer.pid).descriptors < before
            until(lambda: not server.alive())
            peer.tell("close")  # as a run does in its end
            peer.hear("closed")
        finally:
            peer.close()
        assert [*own_folder.iterdir()] == []  # the client has removed the socket, which has a name
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:  # as by a client that was killed, too
        left.bind(str(own_folder / "left.sock"))
    with serving("shm") as second:
        assert [*own_folder.iterdir()] == [Path(second.address)]
        with closing(open_client(wiring_of("shm", second.address))) as client:
            assert len(ask(client, Request("a", "go on", max_tokens=2))[0]) == 2


def test_a_client_that_is_killed_in_mid_answer_leaves_nothing() -> None:
    with serving("shm") as server, closing(open_client(wiring_of("shm", server.address))) as honest:
        ask(honest, Request("a", "go on", max_tokens=1))
        before = usage(server.pid)
        peer = Peer(wiring_of("shm", server.address), server.pid)
        try:
            peer.hear("ready", seconds=60)
            peer.tell("ask")
            peer.hear("token")
            assert usage(server.pid).descriptors > before.descriptors
            assert named_memory(server.pid, peer.pid) == []
            os.kill(peer.pid, 9)
            assert len(ask(honest, Request("a", "go on", max_tokens=2))[0]) == 2
            until(lambda: usage(server.pid).descriptors == before.descriptors)
            until(lambda: usage(server.pid).threads == before.threads)
        finally:
            peer.close()


def test_servers_that_start_at_once_do_not_take_each_other_for_dead() -> None:
    number = 12
    barrier = Barrier(number)
    listeners: list[tuple[socket.socket, str]] = []

    def start() -> None:
        barrier.wait()
        listeners.append(unix_socket.listen(""))

    threads = [Thread(target=start) for _ in range(number)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(listeners) == number
    for listener, path in listeners:
        unix_socket.connect(path, 5).close()
        listener.close()


def test_the_socket_is_its_users_alone(own_folder: Path) -> None:
    listener, name = unix_socket.listen("")
    with listener:
        path = Path(name)
        assert path.parent == own_folder
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(own_folder.stat().st_mode) == 0o700


def test_a_folder_that_others_may_enter_is_refused_in_one_line(own_folder: Path) -> None:
    own_folder.mkdir(mode=0o755)
    with pytest.raises(TransportError, match=r"is not a folder of ours alone: remove it, or name a `socket`"):
        open_server(wiring_of("shm"), RecordingHandler([]))


def test_a_link_in_place_of_the_folder_is_refused(own_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    own_folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(TransportError, match="is not a folder of ours alone"):
        open_server(wiring_of("shm"), RecordingHandler([]))


def test_a_socket_of_ones_own_is_used_once_and_never_takes_the_place_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.sock"
    wiring = wiring_of("shm", str(path))
    listener, _ = unix_socket.listen(str(path))
    with listener, pytest.raises(PortInUse, match=r"`socket`: .*robot.sock cannot be had"):
        open_server(wiring, RecordingHandler([]))
    assert path.is_socket()  # as of a server that was killed
    server = open_server(wiring, RecordingHandler([]))
    server.stop()
    server.stop()
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(PortInUse):
        open_server(wiring, RecordingHandler([]))
    assert path.read_text() == "mine"
    with pytest.raises(PortInUse, match="nowhere"):
        open_server(wiring_of("shm", str(tmp_path / "nowhere" / "a.sock")), RecordingHandler([]))


def test_another_version_of_us_is_told_as_such() -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        one.send(HELLO.pack(MAGIC[:-1] + b"1", 4096))
        with pytest.raises(TransportError, match="no s2a-bench, or one whose shared memory is laid out otherwise"):
            accept(other, 4096)


def test_a_packet_that_is_none_is_no_answer() -> None:
    listener, path = unix_socket.listen("")

    def serve() -> None:
        link, _ = listener.accept()
        with link:
            kept = accept(link, 1 << 30), offer(link, ANSWER_BYTES)
            link.recv(PLACE.size)
            link.send(b"abc")
            del kept

    server = Thread(target=serve)
    server.start()
    with (
        listener,
        closing(open_client(wiring_of("shm", path))) as client,
        pytest.raises(RequestFailed, match="sent what is no answer: "),
    ):
        ask(client, Request("a", "plan"))
    server.join()


def test_a_limit_that_is_no_whole_step_is_kept_all_the_same() -> None:
    for connect in connector(replace(wiring_of("shm"), limits=Limits(body_mib=0.5))):
        client = connect(RecordingHandler(["x"]))
        assert len(ask(client, Request("a", "plan"))[0]) == 1
        with pytest.raises(RequestFailed):
            ask(client, Request("b", "p" * (1 << 19)))


def test_the_memory_of_a_long_answer_is_given_back() -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        answers = offer(one, ANSWER_BYTES)
        writer = Writer(Wire(one), answers)
        writer.send(b"x" * (2 * STEP_BYTES))
        writer.begin()
        assert answers.map[: 2 * STEP_BYTES] == bytes(2 * STEP_BYTES)


def test_memory_above_the_limit_is_refused() -> None:
    for connect in connector(replace(wiring_of("shm"), limits=Limits(body_mib=2))):
        client = connect(RecordingHandler(["x"]))
        with pytest.raises(RequestFailed, match=r"refused: shared memory of \d+ bytes was offered; at most"):
            ask(client, Request("a", "plan", (yuyv_frame(1280, 960),)))
        assert len(ask(client, Request("a", "plan"))[0]) == 1


def test_nobody_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ServerDied, match=r"no server accepts connections at .*: No such file or directory"):
        open_client(wiring_of("shm", str(tmp_path / "nobody.sock")))


def test_a_system_without_such_memory_says_so_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("os.memfd_create")
    for opens in (
        lambda: open_client(wiring_of("shm", "x")),
        lambda: open_server(wiring_of("shm"), RecordingHandler([])),
    ):
        with pytest.raises(UsageError, match=r"`transport` shm: it needs Linux \(memfd_create\); this is"):
            opens()
    found = shared_memory(Machine())
    assert found
    assert (found.code, found.level, found.fix) == ("shared-memory", "advice", "leave it out")


def test_a_sandbox_that_forbids_such_memory_is_named(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any) -> int:
        raise PermissionError(1, "Operation not permitted")

    assert shared_memory(Machine()) is None
    monkeypatch.setattr(os, "memfd_create", forbidden)
    found = shared_memory(Machine())
    assert found
    assert "memfd_create: Operation not permitted" in found.message
    with pytest.raises(TransportError, match=r"shared memory of \d+ bytes cannot be had: Operation not permitted"):
        connect(RecordingHandler(["x"]))


SAID = st.one_of(
    st.builds(
        Token, st.integers(0, 2**32 - 1), st.text(st.characters(exclude_categories=["Cs"])), st.integers(-1, 2**40)
    ),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.builds(Remote, st.text("abc"), st.lists(st.tuples(st.text("abc"), st.integers(0, 2**61)))),
)


@given(SAID)
def test_what_is_packed_is_what_is_read(said: Token | Remote | str) -> None:
    assert [*unpacked(packed(said) + packed("over"))] == [said, "over"]


@given(st.binary(max_size=40))
def test_any_bytes_are_a_piece_or_one_of_these_errors(data: bytes) -> None:
    try:
        pieces = [*unpacked(data)]
    except (RequestFailed, ValueError, KeyError, TypeError, struct.error):
        return
    assert all(isinstance(said, (Token, Action, Remote, str)) for said in pieces)


@given(st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 2)), max_size=400))
def test_pieces_of_any_sizes_come_in_order_however_late_they_are_read(pieces: list[tuple[int, int]]) -> None:
    wiring, heard = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    file = os.memfd_create("test")
    os.ftruncate(file, ANSWER_BYTES)
    answers = SharedMemory(file, ANSWER_BYTES, writes=True)
    os.close(file)
    with wiring, heard:
        heard.setblocking(False)
        wiring.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # as little as may be: a few packets
        writer = Writer(Wire(wiring), answers)
        got: list[object] = []

        def take(most: int) -> None:
            for _ in range(most):
                with suppress(BlockingIOError):
                    begin, length = PLACE.unpack(heard.recv(PLACE.size))
                    got.extend(unpacked(answers.map[begin : begin + length]))

        for _ in range(2):
            sent = [Token(index, "x" * size, index) for index, (size, _) in enumerate(pieces)]
            got.clear()
            writer.begin()
            for token, (_, reads) in zip(sent, pieces, strict=True):
                writer.send(packed(token))
                take(reads)
            finishing = Thread(target=writer.finish, args=(20,))
            finishing.start()
            while len(got) < len(sent):
                take(1)
            finishing.join(20)
            assert got == sent


def test_an_answer_that_its_memory_has_no_room_for_ends_with_the_reason(connect: Connect) -> None:
    handler = RecordingHandler(["long" * (1 << 20)] * (ANSWER_BYTES >> 22))
    with pytest.raises(RequestFailed, match="this wire carries no more"):
        ask(connect(handler), Request("a", "plan", max_tokens=10_000))
    assert len(ask(connect(RecordingHandler(["x"])), Request("b", "plan"))[0]) == 1
