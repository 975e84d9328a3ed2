"""openpi's protocol through a tap: what is seen of it."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus, ProtocolError
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from s2a_bench.plugins.policy_servers.websocket import WEBSOCKET, tap
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.plugins.policy_servers.websocket.tap import WebsocketReader
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.transport import open_client
from s2a_bench.transport.tap import FAILED
from s2a_bench.types import Request
from tests.servers.policy_websocket import handled_by, policy_server, relative
from tests.transport.test_http_tap import DOWN, UP, Direction, alike, fed, tapped
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
OBSERVATION = {"observation/image": np.zeros((48, 64, 3), np.uint8), "observation/state": np.ones(7), "prompt": "go"}
ANSWER = {"actions": CHUNK, "server_timing": {"infer_ms": 12.5}}
plain = {"compression": None, "max_size": None, "proxy": None, "close_timeout": 1}


def robot(address: str, **more: Any) -> Any:
    return connect(address, **{**plain, **more})


# real peers


def test_a_robot_that_is_greeted_has_an_exchange_for_each_observation() -> None:
    with relative(lambda _: ANSWER) as (address, _), tapped(f"{address}/pi0?key=secret", WebsocketReader) as tap_:
        with robot(tap_.address) as peer:
            assert unpackb(peer.recv()) == {"model": "pi0"}
            for _ in range(3):
                peer.ping().wait(20)
                peer.send(packb(OBSERVATION))
                came = peer.recv()
        seen = tap_.after(3)
        until(lambda: tap_.relay.totals.pings)
    assert [each.what for each in seen] == ["websocket /pi0"] * 3
    sizes = {(each.up_bytes, each.down_bytes, each.chunk, each.infer_ms) for each in seen}
    assert sizes == {(len(packb(OBSERVATION)), len(came), (4, 3), 12.5)}
    assert [each.observation is None for each in seen] == [False, True, True]
    assert seen[0].observation["prompt"] == "go"
    assert seen[0].observation["observation/image"].shape == (48, 64, 3)
    assert tap_.relay.totals.pings == 3


@pytest.mark.parametrize("variant", ["openpi", "openpi-stream"])
def test_our_client_and_server_whose_marks_are_no_answer(variant: str) -> None:
    name = f"websocket/{variant}"
    with (
        served(wiring_of(name), RecordingHandler(list(CHUNK))) as (server, _),
        tapped(server.address, WebsocketReader) as tap_,
    ):
        client = open_client(wiring_of(name, tap_.address))
        for _ in range(3):
            actions, trace = ask(client, Request("r-1", "go", (yuyv_frame(),)))
            assert len(actions) == 4
            assert trace.remote is not None
        client.close()
        seen = tap_.after(3)
    streams = variant == "openpi-stream"
    assert {each.what for each in seen} == {f"websocket {'/stream' if streams else '/'}"}
    for each in seen:
        assert (each.chunk, len(each.pieces_ns), each.error) == ((4, 3), 4 if streams else 0, "")
        assert each.infer_ms is not None
        assert 0 < each.infer_ms * 1e6 < each.end_ns - each.request_ns


@pytest.mark.filterwarnings("ignore:connect.. must be used as a context manager:DeprecationWarning")
def test_openpis_own_client() -> None:
    openpi = pytest.importorskip("openpi_client.websocket_client_policy")
    with (
        served(wiring_of("websocket"), RecordingHandler(list(CHUNK))) as (server, _),
        tapped(server.address, WebsocketReader) as tap_,
    ):
        policy = openpi.WebsocketClientPolicy(tap_.address)
        np.testing.assert_array_equal(policy.infer(OBSERVATION)["actions"], CHUNK)
        policy._ws.close()
        assert tap_.after(1)[0].chunk == (4, 3)


def test_a_foreign_client_and_server_and_its_traceback() -> None:
    with policy_server() as address, tapped(address, WebsocketReader) as tap_:
        with robot(tap_.address) as peer:
            peer.recv()
            peer.send(packb(OBSERVATION))
            assert unpackb(peer.recv())["actions"].shape == (10, 7)
            peer.send(packb({**OBSERVATION, "prompt": "fail"}))
            assert "Traceback" in peer.recv()
        seen = tap_.after(2)
    assert [each.chunk for each in seen] == [(10, 7), None]
    assert [each.error for each in seen] == ["", FAILED]


def test_pages_and_a_refused_handshake_are_exchanges_of_http(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOT_KEY", "open sesame")
    wiring = wiring_of("websocket", api_key_env="ROBOT_KEY")
    with served(wiring, RecordingHandler(list(CHUNK))) as (server, _), tapped(server.address, WebsocketReader) as tap_:
        assert httpx.get(tap_.address.replace("ws:", "http:") + "/healthz").text == "OK\n"
        with pytest.raises(InvalidStatus), robot(tap_.address):
            pass
        seen = tap_.after(2)
    assert [(each.what, each.error) for each in seen] == [("GET /healthz", ""), ("GET /", "HTTP 401")]


def test_compressed_messages_have_sizes_and_times_alone() -> None:
    with (
        handled_by(
            lambda peer: peer.send(packb(ANSWER) if peer.recv() else b""), {"a": 1}, compression="deflate"
        ) as at,
        tapped(at, WebsocketReader) as tap_,
        robot(tap_.address, compression="deflate") as peer,
    ):
        peer.recv()
        peer.send(packb(OBSERVATION))
        came = peer.recv()
        (seen,) = tap_.after(1)
    assert 0 < seen.down_bytes < len(came)
    assert 0 < seen.up_bytes < len(packb(OBSERVATION)) / 10
    assert (seen.chunk, seen.infer_ms, seen.observation, seen.error) == (None, None, None, "")


def test_fragments_with_a_ping_among_them_are_one_message() -> None:
    def handle(peer: Any) -> None:
        for message in peer:
            answer = packb({**ANSWER, "size": len(message)})
            peer.send([answer[:7], answer[7:50], answer[50:]])

    data = packb(OBSERVATION)
    with handled_by(handle) as address, tapped(address, WebsocketReader) as tap_, robot(tap_.address) as peer:
        for _ in range(2):
            peer.send(part for part in (data[:9], data[9:200], data[200:]))
            came = peer.recv()
            assert unpackb(came)["size"] == len(data)
        seen = tap_.after(2)
    for each in seen:
        assert (each.up_bytes, each.down_bytes, each.chunk, each.infer_ms) == (len(data), len(came), (4, 3), 12.5)
    assert seen[0].observation["prompt"] == "go"


# recorded bytes

HANDSHAKE: list[Direction] = [
    (UP, b"GET /pi0?key=1 HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"),
    (DOWN, b"HTTP/1.1 101 Yes\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"),
]


def up(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True) -> Direction:
    return UP, Frame(opcode, data, fin).serialize(mask=True)


def down(data: bytes | str, opcode: Opcode = Opcode.BINARY, *, fin: bool = True) -> Direction:
    if isinstance(data, str):
        return down(data.encode(), Opcode.TEXT)
    return DOWN, Frame(opcode, data, fin).serialize(mask=False)


def partial(rows: Any) -> Direction:
    return down(packb({"type": "partial", "actions": rows}))


PARTS: dict[str, tuple[list[Direction], list[Any]]] = {
    "a ping of the server while it works": (
        [up(b"\x80"), down(b"", Opcode.PING), up(b"", Opcode.PONG), down(packb(ANSWER))],
        [(1, len(packb(ANSWER)), 0, (4, 3), 12.5, "")],
    ),
    "a greeting in the handshake's packet": (
        [down(packb({"actions": "?"})), up(b"\x80"), down(packb(ANSWER))],
        [(1, len(packb(ANSWER)), 0, (4, 3), 12.5, "")],
    ),
    "an empty message that keeps the connection open": (
        [up(b""), up(b"\x80"), down(b"\x81\xa6action\x93\x01\x02\x03")],
        [(1, 12, 0, (1, 3), None, "")],
    ),
    "two requests at once": (
        [up(b"\x80"), up(b"\x80"), down(packb(ANSWER)), down(b"\x80")],
        [(1, len(packb(ANSWER)), 0, (4, 3), 12.5, ""), (1, 1, 0, None, None, "")],
    ),
    "a stream whose final message has no actions": (
        [up(b"\x80"), partial(CHUNK[:1]), partial(CHUNK[1:]), down(packb({"type": "final"}))],
        [(1, 192, 2, (4, 3), None, "")],
    ),
    "a traceback": (
        [up(b"\x80"), down('Traceback:\n  File "x"\nValueError: no\n'), down(b"\x03\xf3", Opcode.CLOSE)],
        [(1, 37, 0, None, None, FAILED)],
    ),
    "an answer as JSON": (
        [up(b"{}", Opcode.TEXT), down('{"actions": [[1, 2]], "more": 123}')],
        [(2, 34, 0, (1, 2), None, "")],
    ),
    "an error as a map": (
        [up(b"\x80"), down(packb({"type": "error", "payload": {"message": "a\nb"}}))],
        [(1, 33, 0, None, None, FAILED)],
    ),
    "odd values": (
        [up(b"\xc1"), down(packb({"type": CHUNK, "actions": {"a": 1}, "error": CHUNK, "server_timing": 3}))],
        [(1, len(packb({"type": CHUNK, "actions": {"a": 1}, "error": CHUNK, "server_timing": 3})), 0, None, None, "")],
    ),
    "an answer before the request's end": (
        [up(b"\x80", fin=False), down("too large"), up(b"\x80", Opcode.CONT), up(b"\x80"), down(b"\x80")],
        [(2, 9, 0, None, None, FAILED), (1, 1, 0, None, None, "")],
    ),
    "a connection that ends": ([up(b"\x80")], [(1, 0, 0, None, None, "the connection ended before the answer")]),
}


@pytest.mark.parametrize("step", [0, 1, 7])
@pytest.mark.parametrize("name", PARTS)
def test_the_same_is_seen_however_the_bytes_come(name: str, step: int) -> None:
    parts, expected = PARTS[name]
    if "packet" in name:
        parts = [HANDSHAKE[0], (DOWN, HANDSHAKE[1][1] + parts[0][1]), *parts[1:]]
    else:
        parts = [*HANDSHAKE, *parts]
    seen = fed(WebsocketReader, parts, step)
    assert {each.what for each in seen} == {"websocket /pi0"}
    found = [(s.up_bytes, s.down_bytes, len(s.pieces_ns), s.chunk, s.infer_ms, s.error) for s in seen]
    assert found == expected


def test_the_transport_declares_its_reader() -> None:
    assert resolve_name(WEBSOCKET.reader) is WebsocketReader


def test_times_are_those_of_first_and_last_bytes() -> None:
    parts = [up(b"\x80"), down(b"", Opcode.PING), down(packb(ANSWER))]
    (seen,) = fed(WebsocketReader, [*HANDSHAKE, *parts], 1)
    edges = np.cumsum([sum(len(data) for _, data in HANDSHAKE), *(len(data) for _, data in parts)]) * 10
    assert (seen.request_ns, seen.sent_ns) == (edges[0] + 10, edges[1] + 1)
    assert (seen.answer_ns, seen.end_ns) == (edges[2] + 10, edges[3] + 1)


def test_large_messages_are_counted_and_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tap, "MOST_BYTES", 1000)
    monkeypatch.setattr(tap, "DECODED_BYTES", 1000)
    large = packb({"actions": np.zeros((50, 20))})
    parts = [up(packb(OBSERVATION)), down(large[:900], fin=False), down(large[900:], Opcode.CONT)]
    (seen,) = fed(WebsocketReader, [*HANDSHAKE, *parts], 500)
    assert (seen.up_bytes, seen.down_bytes) == (len(packb(OBSERVATION)), len(large))
    assert (seen.observation, seen.chunk, seen.error) == (None, None, "")


def test_frames_that_break_the_protocol_raise() -> None:
    with pytest.raises(ProtocolError, match="masking"):
        fed(WebsocketReader, [*HANDSHAKE, (UP, down(b"\x80")[1])])


DATA = st.binary(max_size=99) | st.sampled_from([packb(ANSWER), packb({"type": "partial", "actions": CHUNK})])
OPCODES = st.sampled_from([Opcode.BINARY, Opcode.TEXT, Opcode.CONT])
FRAMES = st.one_of(
    st.builds(lambda data, opcode, fin: up(data, opcode, fin=fin), DATA, OPCODES, st.booleans()),
    st.builds(lambda data, opcode, fin: down(data, opcode, fin=fin), DATA, OPCODES, st.booleans()),
    st.sampled_from([up(b"", Opcode.PING), down(b"1", Opcode.PONG), down(b"", Opcode.CLOSE)]),
)
NOISE = st.tuples(st.booleans(), st.binary(max_size=99))


@given(parts=st.lists(FRAMES | NOISE, max_size=12))
def test_odd_bytes_raise_or_are_seen_alike(parts: list[Direction]) -> None:
    found = []
    for step in (0, 1):
        try:
            found.append(alike(fed(WebsocketReader, [*HANDSHAKE, *parts], step)))
        except Exception as error:  # noqa: BLE001 - the relay catches any
            found.append([type(error)])
    assert found[0] == found[1]
