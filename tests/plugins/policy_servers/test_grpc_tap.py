"""What a tap reads of gRPC's calls: through the relay, of lerobot's and any other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from threading import Event
from typing import Any

import grpc
import numpy as np
import pytest
from hpack import Encoder
from hyperframe.frame import (
    ContinuationFrame,
    DataFrame,
    Frame,
    GoAwayFrame,
    HeadersFrame,
    PingFrame,
    RstStreamFrame,
    SettingsFrame,
)
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.policy_servers.grpc.client import LOAD, SERVICE, message_of
from s2a_bench.plugins.policy_servers.grpc.pickles import pickled
from s2a_bench.plugins.policy_servers.grpc.tap import PREFACE, GrpcReader
from s2a_bench.testing.transport import ask, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.types import Request
from tests.plugins.policy_servers.test_zmq_tap import Copies, Tap, facts, replayed, tapped
from tests.servers.lerobot import END, PolicyServer, chunk, grpc_server
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
LARGE = np.zeros((50, 32), np.float32)
SEND, GET, LEROBOT = f"{SERVICE}SendObservations", f"{SERVICE}GetActions", "grpc lerobot"


@contextmanager
def channel(port: int, **options: int) -> Iterator[grpc.Channel]:
    settings = [("grpc.enable_http_proxy", 0), *((f"grpc.{name}", value) for name, value in options.items())]
    with grpc.insecure_channel(f"127.0.0.1:{port}", settings) as opened:
        yield opened


@contextmanager
def policy(reply: Callable[[Any], bytes | None]) -> Iterator[tuple[PolicyServer, Tap]]:
    server = PolicyServer(reply)
    with grpc_server([server.handlers()]) as url, tapped(GrpcReader, url) as tap:
        yield server, tap


def pieces(stamp: float, size: int = 100) -> list[bytes]:
    """An observation of this many bytes."""
    fields = {"timestamp": stamp, "timestep": 1, "observation": {"picture": bytes(size)}, "must_go": True}
    return [bytes((8, END)) + message_of(pickled("TimedObservation", fields), 2)]


def test_our_own_client_is_read_with_pictures_of_several_megabytes() -> None:
    frames = (yuyv_frame(1280, 960, seed=1), yuyv_frame(640, 480, seed=2))
    wire = {"policy_type": "act", "pretrained": "me/act", "timeout_s": 20}
    with policy(lambda seen: chunk(seen.timestamp, LARGE)) as (server, tap):
        with closing(open_client(wiring_of("grpc/lerobot", url=f"grpc://127.0.0.1:{tap.port}", **wire))) as client:
            for name in "abc":
                ask(client, Request(name, "go", frames, state=(0.5, 1.5)))
        told = tap.told(5)
        assert tap.lines == []
    assert [each[0] for each in told] == [f"grpc {SERVICE}Ready", f"grpc {SERVICE}{LOAD}", *[LEROBOT] * 3]
    assert (told[0][1:], told[1][2:]) == ((5, 5, None, ""), (5, None, ""))
    answer = len(chunk(0.5, LARGE)) + 4 + 5  # protobuf's and gRPC's heads
    assert [each[2:] for each in told[2:]] == [(answer, (50, 32), "")] * 3
    assert min(each[1] for each in told[2:]) > 3 * (1280 * 960 + 640 * 480)
    assert len(server.observations) == 3
    assert tap.relay.totals.pings > 0  # grpcio estimates the bandwidth so
    for size in (0, 9, 10_000):
        assert [*map(facts, replayed(GrpcReader, tap.copies, size))] == told


def test_bytes_one_by_one_tell_the_same() -> None:
    with policy(lambda seen: chunk(seen.timestamp, CHUNK)) as (_, tap), channel(tap.port) as opened:
        for stamp in (1.5, 2.5):
            answer = opened.unary_unary(GET).future(b"")
            opened.stream_unary(SEND)(iter(pieces(stamp)))
            assert answer.result()
        told = tap.told(2)
    assert [each[0] for each in told] == [LEROBOT] * 2
    assert [*map(facts, replayed(GrpcReader, tap.copies, 1))] == told


def test_a_chunk_belongs_to_the_observation_of_its_time_whatever_was_sent_since() -> None:
    gate = Event()

    def reply(seen: Any) -> bytes:
        assert gate.wait(20)
        return chunk(seen.timestamp, CHUNK)

    with policy(reply) as (server, tap), channel(tap.port) as opened:
        answer = opened.unary_unary(GET).future(b"")
        send = opened.stream_unary(SEND)
        for stamp, size in ((1.5, 100), (2.5, 3 << 20)):
            send(iter(pieces(stamp, size)))
        until(lambda: len(server.observations) == 2)
        gate.set()
        answer.result()
        opened.unary_unary(GET)(b"")
        told = tap.told(2)
    assert [(what, up > 1 << 20, shape) for what, up, _, shape, _ in told] == [
        (LEROBOT, False, (4, 3)),
        (LEROBOT, True, (4, 3)),
    ]
    first, second = tap.seen
    assert second.request_ns < first.answer_ns < second.answer_ns


@pytest.mark.parametrize(("reply", "shape"), [(b"no pickle", None), (chunk(9.5, CHUNK), (4, 3))])
def test_a_chunk_that_names_no_observation_belongs_to_the_newest(reply: bytes, shape: Any) -> None:
    with policy(lambda _: reply) as (_, tap), channel(tap.port) as opened:
        answer = opened.unary_unary(GET).future(b"")
        opened.stream_unary(SEND)(iter(pieces(1.5)))
        answer.result()
        ((what, *_, chunk_, error),) = tap.told(1)
    assert (what, chunk_, error) == (LEROBOT, shape, "")


def test_an_answer_without_a_chunk_is_no_exchange() -> None:
    replies = iter([None, chunk(2.5, CHUNK)])
    with policy(lambda _: next(replies)) as (_, tap), channel(tap.port) as opened:
        for stamp in (1.5, 2.5):
            answer = opened.unary_unary(GET).future(b"")
            opened.stream_unary(SEND)(iter(pieces(stamp)))
            answer.result()
        tap.told(1)
    assert len(tap.seen) == 1


def service(wait: Event) -> Any:
    """Methods of nobody's: a slow one, one of several messages, one that fails, one that waits for ever."""

    def slow(request: bytes, _: Any) -> bytes:
        assert wait.wait(20)
        return request * 2

    def count(request: bytes, _: Any) -> Iterator[bytes]:
        yield from [request] * 3

    def fail(_: bytes, context: Any) -> bytes:
        context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too many")
        return b""

    unary = grpc.unary_unary_rpc_method_handler
    methods = {
        "Slow": unary(slow),
        "Echo": unary(lambda request, _: request),
        "Count": grpc.unary_stream_rpc_method_handler(count),
        "Fail": unary(fail),
    }
    return grpc.method_handlers_generic_handler("any.Robot", methods)


@contextmanager
def robot() -> Iterator[tuple[Event, Tap]]:
    wait = Event()
    with grpc_server([service(wait)]) as url, tapped(GrpcReader, url) as tap:
        try:
            yield wait, tap
        finally:
            wait.set()


def test_calls_that_interleave_are_told_apart_with_their_pieces_and_errors() -> None:
    with robot() as (wait, tap), channel(tap.port) as opened:
        slow = opened.unary_unary("/any.Robot/Slow").future(bytes(1 << 20))
        echoed = opened.unary_unary("/any.Robot/Echo")(bytes(1000))
        assert len(echoed) == 1000
        counted = [*opened.unary_stream("/any.Robot/Count")(bytes(7))]
        with pytest.raises(grpc.RpcError):
            opened.unary_unary("/any.Robot/Fail")(b"x")
        tap.told(3)
        wait.set()
        slow.result()
        told = tap.told(4)
    assert told == [
        ("grpc /any.Robot/Echo", 1005, 1005, None, ""),
        ("grpc /any.Robot/Count", 12, 36, None, ""),
        ("grpc /any.Robot/Fail", 6, 0, None, "gRPC RESOURCE_EXHAUSTED"),
        ("grpc /any.Robot/Slow", (1 << 20) + 5, (2 << 20) + 5, None, ""),
    ]
    assert [len(each.pieces_ns) for each in tap.seen] == [0, len(counted), 0, 0]
    assert tap.seen[3].request_ns <= tap.seen[0].request_ns  # in one part, perhaps
    assert tap.seen[2].end_ns < tap.seen[3].answer_ns
    for size in (0, 100):
        assert [*map(facts, replayed(GrpcReader, tap.copies, size))] == told


def test_a_call_that_the_client_gives_up_is_an_error() -> None:
    with robot() as (_, tap), channel(tap.port) as opened:
        call = opened.unary_unary("/any.Robot/Slow").future(b"x")
        until(lambda: [each.up_bytes for each in replayed(GrpcReader, [*tap.copies])] == [6])
        call.cancel()
        (told,) = tap.told(1)
    assert told == ("grpc /any.Robot/Slow", 6, 0, None, "client reset the call (8)")


def test_a_server_that_ends_takes_the_observation_with_it() -> None:
    over = Event()
    with ExitStack() as stack:
        server = PolicyServer(lambda _: over.wait(20) and None)
        ended = grpc.server(ThreadPoolExecutor(4), handlers=[server.handlers()])
        port = ended.add_insecure_port("127.0.0.1:0")
        ended.start()
        tap = stack.enter_context(tapped(GrpcReader, port))
        opened = stack.enter_context(channel(tap.port))
        answer = opened.unary_unary(GET).future(b"")
        opened.stream_unary(SEND)(iter(pieces(1.5)))
        ended.stop(0).wait(20)
        with pytest.raises(grpc.RpcError):
            answer.result()
        ((what, up, down, _, error),) = tap.told(1)
        over.set()
    assert (what, up > 100, down) == (LEROBOT, True, 0)
    assert error


class Peers:
    """Frames written by hand, whose headers are coded with one table for each direction."""

    def __init__(self) -> None:
        self.encoders = {True: Encoder(), False: Encoder()}
        self.copies: Copies = [(PREFACE, True)]
        self.put(SettingsFrame(0), SettingsFrame(0), up=True)
        self.put(SettingsFrame(0), SettingsFrame(0, flags=["ACK"]), up=False)

    def put(self, *frames: Frame, up: bool) -> None:
        self.copies += [(frame.serialize(), up) for frame in frames]

    def headers(self, stream: int, *flags: str, up: bool, **fields: str) -> HeadersFrame:
        named = [(name.replace("_", "-", 1) if name != "path" else ":path", value) for name, value in fields.items()]
        return HeadersFrame(stream, self.encoders[up].encode(named), flags=["END_HEADERS", *flags])

    def told(self, size: int = 0) -> list[tuple[Any, ...]]:
        return [facts(each) for each in replayed(GrpcReader, self.copies, size)]


def message(size: int) -> bytes:
    return b"\0" + size.to_bytes(4, "big") + bytes(size)


@pytest.mark.parametrize("size", [0, 1])
def test_padding_priority_continuations_and_empty_last_frames_are_read(size: int) -> None:
    peers = Peers()
    whole = peers.headers(1, up=True, path="/a.B/C", x_long="v" * 300)
    first = HeadersFrame(1, whole.data[:9], flags=["PRIORITY", "PADDED"])
    first.pad_length, first.depends_on, first.stream_weight = 9, 3, 16
    rest = [ContinuationFrame(1, whole.data[9:50]), ContinuationFrame(1, whole.data[50:], flags=["END_HEADERS"])]
    data = DataFrame(1, message(10), flags=["PADDED"])
    data.pad_length = 200
    peers.put(first, *rest, data, PingFrame(0), DataFrame(1, b"", flags=["END_STREAM"]), up=True)
    peers.put(peers.headers(1, up=False, content_type="application/grpc"), DataFrame(1, message(20)[:3]), up=False)
    peers.put(PingFrame(0, flags=["ACK"]), DataFrame(1, message(20)[3:]), up=False)
    peers.put(peers.headers(1, "END_STREAM", up=False, grpc_status="0", x_trace="a"), up=False)
    again = peers.headers(3, up=True, path="/a.B/C", x_long="v" * 300)
    assert len(again.data) < 10  # from the table
    peers.put(again, DataFrame(3, message(10), flags=["END_STREAM"]), up=True)
    peers.put(peers.headers(3, "END_STREAM", up=False, grpc_status="14", x_trace="a"), up=False)
    assert peers.told(size) == [("grpc /a.B/C", 15, 25, None, ""), ("grpc /a.B/C", 15, 0, None, "gRPC UNAVAILABLE")]


def test_a_reset_and_the_end_of_a_connection_end_calls_with_an_error() -> None:
    peers = Peers()
    for stream in (1, 3):
        peers.put(peers.headers(stream, up=True, path="/a.B/C"), DataFrame(stream, message(1)), up=True)
    peers.put(RstStreamFrame(1, error_code=2), RstStreamFrame(99, error_code=2), GoAwayFrame(0, 3), up=False)
    gone = "the connection ended before the answer"
    assert [each[4] for each in peers.told()] == ["server reset the call (2)", gone]


def test_a_half_sent_observation_is_not_the_one_that_is_answered() -> None:
    peers = Peers()
    peers.put(peers.headers(1, up=True, path=GET), DataFrame(1, message(0), flags=["END_STREAM"]), up=True)
    for stream, flags in ((3, ["END_STREAM"]), (5, [])):
        peers.put(peers.headers(stream, up=True, path=SEND), DataFrame(stream, message(stream), flags=flags), up=True)
    peers.put(DataFrame(1, message(9)), peers.headers(1, "END_STREAM", up=False, grpc_status="0"), up=False)
    gone = "the connection ended before the answer"
    assert peers.told() == [(LEROBOT, 8, 14, None, ""), (LEROBOT, 10, 0, None, gone)]


@pytest.mark.parametrize(
    "frames",
    [
        [HeadersFrame(1, b"\x3f\xe1\xff\xff\x03", flags=["END_HEADERS"])],  # a table of 64 MiB
        [HeadersFrame(1), *[ContinuationFrame(1, bytes(16_000))] * 9],
        [HeadersFrame(1), DataFrame(1, b"x")],
        [HeadersFrame(stream, b"\x04\x02/a", flags=["END_HEADERS"]) for stream in range(1, 2100, 2)],
    ],
)
def test_what_would_take_memory_is_refused(frames: list[Frame]) -> None:
    peers = Peers()
    peers.put(*frames, up=True)
    with pytest.raises(Exception, match=r"table size|do not end|1000 calls"):
        peers.told()


def test_http_1_is_refused() -> None:
    with pytest.raises(ValueError, match="not HTTP/2"):
        replayed(GrpcReader, [(b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n", True)])


def framed(kind: int, flags: int, stream: int, body: bytes) -> bytes:
    return len(body).to_bytes(3, "big") + bytes((kind, flags)) + stream.to_bytes(4, "big") + body


frames = st.builds(framed, st.integers(0, 10), st.integers(0, 255), st.integers(0, 5), st.binary(max_size=60))
opened = st.sampled_from(
    [
        framed(1, 4, stream, b"\x04" + bytes((len(path),)) + path.encode())
        for stream, path in ((1, SEND), (3, GET), (5, "/a"))
    ]
)


@given(st.lists(st.tuples(st.one_of(st.binary(max_size=50), frames, opened), st.booleans())))
def test_random_frames_are_told_by_an_exception_or_not_at_all(parts: Copies) -> None:
    reader = GrpcReader(lambda _: None, set())
    with suppress(Exception):
        for data, up in [(PREFACE, True), *parts]:
            reader.passed(data, 1, 2, up=up)
    reader.end()
