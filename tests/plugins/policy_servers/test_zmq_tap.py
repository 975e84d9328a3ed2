"""What a tap reads of GR00T's protocol: through the relay, between peers of pyzmq, and our own."""

from __future__ import annotations

import asyncio
import io
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from threading import Event, Thread
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.policy_servers.zmq.tap import ZmqReader, what_in
from s2a_bench.plugins.watch.relay import ByteRelay
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.transport.tap import FAILED, Seen, TapReader
from s2a_bench.types import Request
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
Copies = list[tuple[bytes, bool]]
"""What passed, and whether it went up."""


class Tap:
    """A relay in front of a port, what it told, and copies of what passed."""

    def __init__(self, kind: Callable[..., TapReader], port: int) -> None:
        self.seen: list[Seen] = []
        self.lines: list[str] = []
        self.copies: Copies = []

        class Copying(kind):  # type: ignore[misc, valid-type]
            def passed(copying, data: bytes, *args: Any, up: bool) -> None:  # noqa: N805
                self.copies.append((data, up))
                super().passed(data, *args, up=up)

        listener = socket.create_server(("127.0.0.1", 0))
        self.port = listener.getsockname()[1]
        self.relay = ByteRelay(
            listener, ("127.0.0.1", port), Copying, lambda _, seen: self.seen.append(seen), self.lines.append
        )

    def told(self, number: int) -> list[tuple[Any, ...]]:
        """What is told of so many exchanges without their times, which are in order."""
        until(lambda: len(self.seen) >= number)
        return [facts(each) for each in self.seen]


def facts(seen: Seen) -> tuple[Any, ...]:
    if not seen.error:
        times = seen.request_ns, seen.answer_ns, seen.end_ns
        assert 0 < times[0] <= seen.sent_ns
        assert list(times) == sorted(times)
    return seen.what, seen.up_bytes, seen.down_bytes, seen.chunk, seen.error


@contextmanager
def tapped(kind: Callable[..., TapReader], port: int | str) -> Iterator[Tap]:
    tap = Tap(kind, int(str(port).rpartition(":")[2]))
    serving = Thread(target=tap.relay.serve)
    serving.start()
    try:
        yield tap
    finally:
        tap.relay.stop()
        serving.join()


def replayed(kind: Callable[..., TapReader], copies: Copies, size: int = 0) -> list[Seen]:
    """What a reader tells of the same bytes, in pieces of this size."""
    seen: list[Seen] = []
    reader = kind(seen.append, set())
    clock = iter(range(1, 1 << 30))
    for data, up in copies:
        for start in range(0, len(data), size or len(data)):
            reader.passed(data[start : start + (size or len(data))], next(clock), next(clock), up=up)
    reader.end()
    return seen


def packed(value: Any) -> Any:
    def file(array: Any) -> Any:
        output = io.BytesIO()
        np.save(output, array, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": output.getvalue()}

    return msgpack.packb(value, default=file)


def asking(endpoint: str, size: int = 8) -> bytes:
    return packed({"endpoint": endpoint, "data": {"video.front": np.zeros(size, np.uint8)}, "api_token": "secret"})


@contextmanager
def router(answers: Callable[[bytes], Sequence[bytes]]) -> Iterator[int]:
    """A ROUTER: its port. Each request gets so many answers; none ends it."""
    context, over = zmq.Context(), Event()
    peer = context.socket(zmq.ROUTER)
    peer.rcvtimeo, peer.linger, peer.heartbeat_ivl, peer.heartbeat_timeout = 20, 0, 30, 20_000
    port = peer.bind_to_random_port("tcp://127.0.0.1")

    def serve() -> None:
        while not over.is_set():
            with suppress(zmq.Again):
                *envelope, body = peer.recv_multipart()
                sent = answers(body)
                for each in sent:
                    peer.send_multipart([*envelope, each])
                if not sent:
                    break
        peer.close()

    thread = Thread(target=serve)
    thread.start()
    try:
        yield port
    finally:
        over.set()
        thread.join()
        context.destroy(0)


@contextmanager
def peer_of(kind: int, port: int, **options: Any) -> Iterator[Any]:
    context = zmq.Context()
    peer = context.socket(kind)
    peer.linger, peer.rcvtimeo = 0, 20_000
    for name, value in options.items():
        setattr(peer, name, value)
    peer.connect(f"tcp://127.0.0.1:{port}")
    try:
        yield peer
    finally:
        context.destroy(0)


ANSWER = packed([{"robot": CHUNK[np.newaxis]}, {}])
OK = packed({"status": "ok"})
ERROR = packed({"error": "no such robot" + "!" * 200})
LARGE = packed({"action": np.zeros((1 << 16, 20))})
BODIES = [
    asking("ping"),
    asking("get_action", 3 << 20),
    asking("get_action"),
    asking("get_action"),
    b"\xc1",
    asking(""),
]


def session(kind: int, **options: Any) -> tuple[list[Seen], Copies, int]:
    given, seen = iter([OK, ANSWER, ERROR, LARGE, b"ERROR", OK]), list[tuple[Any, ...]]()
    with router(lambda _: [next(given)]) as port, tapped(ZmqReader, port) as tap:
        with peer_of(kind, tap.port, **options) as peer:
            for body in BODIES:
                peer.send_multipart([body] if kind == zmq.REQ else [b"one", b"", body])
                peer.recv_multipart()
            if options:
                Event().wait(0.2)  # for heartbeats, of which one is enough
        seen = tap.told(len(BODIES))
        assert tap.lines == []
    more = 0 if kind == zmq.REQ else 3
    assert seen == [
        ("zmq ping", len(BODIES[0]) + more, len(OK) + more, None, ""),
        ("zmq get_action", len(BODIES[1]) + more, len(ANSWER) + more, (4, 3), ""),
        ("zmq get_action", len(BODIES[2]) + more, len(ERROR) + more, None, FAILED),
        ("zmq get_action", len(BODIES[3]) + more, len(LARGE) + more, None, ""),
        ("zmq", 1 + more, 5 + more, None, FAILED),
        ("zmq", len(BODIES[5]) + more, len(OK) + more, None, ""),
    ]
    return tap.seen, tap.copies, tap.relay.totals.pings


def test_requests_of_a_req_socket_are_told_whose_first_of_a_kind_is_decoded() -> None:
    seen, copies, _ = session(zmq.REQ)
    first = seen[1].observation
    assert list(first) == ["video.front"]  # not the key
    assert first["video.front"].shape == (3 << 20,)
    assert [each.observation is None for each in seen] == [False, False, True, True, True, True]
    for size in (0, 5, 1 << 16):
        assert [*map(facts, replayed(ZmqReader, copies, size))] == [*map(facts, seen)]


def test_a_dealers_envelope_is_counted_and_heartbeats_are_no_answers() -> None:
    *_, pings = session(zmq.DEALER, heartbeat_ivl=20, heartbeat_timeout=20_000)
    assert pings > 0


def test_bytes_one_by_one_tell_the_same() -> None:
    with router(lambda _: [ANSWER]) as port, tapped(ZmqReader, port) as tap, peer_of(zmq.REQ, tap.port) as peer:
        for name in ("ping", "get_action"):
            peer.send(asking(name))
            peer.recv()
        told = tap.told(2)
    assert [*map(facts, replayed(ZmqReader, tap.copies, 1))] == told
    assert [each[0] for each in told] == ["zmq ping", "zmq get_action"]


def test_our_own_peers_marks_are_no_answer() -> None:
    frames = (yuyv_frame(640, 480),)
    with served(wiring_of("zmq/gr00t"), RecordingHandler(list(CHUNK))) as (server, _):
        port = server.address.rpartition(":")[2]
        with tapped(ZmqReader, port) as tap:
            wiring = wiring_of("zmq/gr00t", f"tcp://127.0.0.1:{tap.port}", timeout_s=20)
            with closing(open_client(wiring)) as client:
                for name in "abc":
                    ask(client, Request(name, "go", frames, state=(0.5,)))
            told = tap.told(3)
            assert tap.lines == []
    assert [(each[0], each[3], each[4]) for each in told] == [("zmq get_action", (4, 3), "")] * 3
    assert min(each[1] for each in told) > 640 * 480 * 3


def test_the_client_of_strands_robots_is_read() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses the robots that it is for
        strands = pytest.importorskip("strands_robots.policies.groot")
    joints = [f"joint_{number}" for number in range(6)]
    handler = RecordingHandler([np.zeros(6, np.float32)] * 2)
    with served(wiring_of("zmq/gr00t"), handler) as (server, _), tapped(ZmqReader, server.address) as tap:
        theirs = strands.Gr00tPolicy("so100", "127.0.0.1", tap.port)
        assert theirs.client.ping()
        theirs.set_robot_state_keys(joints)
        seen = {"webcam": np.zeros((48, 64, 3), np.uint8), **dict.fromkeys(joints, 0.25)}
        asyncio.run(theirs.get_actions(seen, "go home"))
        theirs.client.__del__()
        told = tap.told(2)
    assert [(each[0], each[3]) for each in told] == [("zmq ping", None), ("zmq get_action", (2, 6))]


def test_a_server_that_ends_before_its_answer_is_an_error() -> None:
    with router(lambda _: []) as port, tapped(ZmqReader, port) as tap, peer_of(zmq.REQ, tap.port) as peer:
        peer.send(asking("get_action"))
        ((what, up, down, _, error),) = tap.told(1)
    assert (what, up, down) == ("zmq get_action", len(asking("get_action")), 0)
    assert error == "the connection ended before the answer"


def test_encrypted_connections_are_read_by_turns() -> None:
    public, secret = zmq.curve_keypair()
    context = zmq.Context()
    server = context.socket(zmq.REP)
    server.curve_secretkey, server.curve_publickey, server.curve_server = secret, public, True
    server.linger, server.rcvtimeo = 0, 20_000
    port = server.bind_to_random_port("tcp://127.0.0.1")
    mine, hidden = zmq.curve_keypair()
    keys = {"curve_secretkey": hidden, "curve_publickey": mine, "curve_serverkey": public}
    with tapped(ZmqReader, port) as tap, peer_of(zmq.REQ, tap.port, **keys) as peer:
        peer.send(asking("ping"))
        server.send(server.recv())
        assert peer.recv() == asking("ping")
        peer.close()
    context.destroy(0)
    assert len(tap.lines) == 1
    assert "encrypted" in tap.lines[0]
    assert {each.what for each in tap.seen} == {"turns"}


@pytest.mark.parametrize(
    ("request_", "what"),
    [
        ({"endpoint": "e" * 60}, "zmq " + "e" * 40),
        ({"endpoint": "a\nb\x00"}, "zmq ab"),
        ({"api_token": "x", "options": [1, {"a": 2}], "endpoint": "reset"}, "zmq reset"),
        ({"data": bytes(600), "endpoint": "reset"}, "zmq"),
        ([1], "zmq"),
    ],
)
def test_a_request_is_named_by_its_endpoint(request_: Any, what: str) -> None:
    assert what_in(packed(request_)[:512]) == what


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01NULL".ljust(24, b"\0") + bytes(32)


@given(st.lists(st.tuples(st.binary(max_size=200), st.booleans())), st.booleans())
def test_random_bytes_are_told_by_an_exception_or_not_at_all(parts: Copies, greeted: bool) -> None:
    reader = ZmqReader(lambda _: None, set())
    with suppress(Exception):
        for data, up in [(GREETING, True), (GREETING, False)] * greeted + parts:
            reader.passed(data, 1, 2, up=up)
    reader.end()


@given(st.binary(max_size=512))
def test_a_random_head_has_a_name(head: bytes) -> None:
    assert what_in(head).startswith("zmq")
