"""Reads gRPC's calls, the streams of an HTTP/2 connection, from its first byte on (grpcio sends no upgrade).

A call is one exchange, from the first DATA byte of its request (headers may go ahead) to the last byte of its answer.

lerobot's `SendObservations` and `GetActions` are one exchange, from an observation to its chunk. Its robot sends more
observations while it waits, most of which the server drops. A chunk belongs to the observation made at the time stamp
of its first action, whose eight bytes stand at the head of that observation's pickle; if none has them, to the newest
one that was sent whole. Older ones were dropped, and an answer without a chunk is not an exchange. Observations are not
decoded, as they are pickles.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import replace
from typing import Final

import grpc
from hpack import Decoder
from hyperframe.frame import ContinuationFrame, DataFrame, Frame, HeadersFrame, PingFrame, RstStreamFrame

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.grpc import LEROBOT
from s2a_bench.plugins.policy_servers.grpc.client import SERVICE, bytes_in
from s2a_bench.plugins.policy_servers.grpc.pickles import chunk_in
from s2a_bench.transport.tap import LETTERS, MOST_WAITING, Incoming, ParsedTapReader, Seen

PREFACE: Final = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
SEND, GET = f"grpc {SERVICE}SendObservations", f"grpc {SERVICE}GetActions"
HEADERS_BYTES: Final = 1 << 16
"""The most bytes of a block of headers, and of hpack's table, whatever the peers agreed on."""
PREFIX: Final = 5
"""Bytes before each message: whether it is compressed, and its size."""
HEAD: Final = 512
"""Bytes of an observation that have its time stamp."""
CHUNK_BYTES: Final = 4 << 20
"""gRPC's own limit of a message."""
OBSERVATIONS: Final = 100
"""The most observations that wait for a chunk."""
ERRORS: Final = {str(code.value[0]).encode(): f"gRPC {code.name}" for code in grpc.StatusCode} | {b"0": ""}


class SeenCall:
    def __init__(self, seen: Seen, piece: Callable[[Seen], None]) -> None:
        self.seen, self.head, self.chunk, self._piece = seen, b"", b"", piece
        self.whole = False  # its request
        self._answer = Incoming(self._messages)

    def up(self, data: bytes, from_ns: int, to_ns: int) -> None:
        self.seen.request_ns = self.seen.request_ns if self.seen.up_bytes else from_ns
        self.seen.sent_ns = to_ns
        self.seen.up_bytes += len(data)
        self.head += data[: HEAD - len(self.head)]

    def down(self, data: bytes, from_ns: int, to_ns: int) -> None:
        self.seen.sent_ns, self.seen.answer_ns = self.seen.sent_ns or from_ns, self.seen.answer_ns or from_ns
        self.seen.end_ns = to_ns
        self.seen.down_bytes += len(data)
        self._answer.feed(data)

    def _messages(self, incoming: Incoming) -> Generator[None, None, None]:
        while True:
            size = int.from_bytes((yield from incoming.read(PREFIX))[1:], "big")
            if self.seen.what == GET and size <= CHUNK_BYTES:
                self.chunk = yield from incoming.read(size)
            else:
                yield from incoming.skip(size)
            self._piece(self.seen)


class GrpcReader(ParsedTapReader):
    def __init__(self, report: Callable[[Seen], None], kinds: set[str]) -> None:
        super().__init__(report, kinds)
        self._calls: dict[int, SeenCall] = {}
        self._observations = deque[SeenCall](maxlen=OBSERVATIONS)

    def messages(self, incoming: Incoming, *, up: bool) -> Generator[None, None, None]:
        if up and (yield from incoming.read(len(PREFACE))) != PREFACE:
            raise ValueError("not HTTP/2")
        decoder = Decoder(HEADERS_BYTES)
        decoder.max_allowed_table_size = HEADERS_BYTES
        while True:
            yield from incoming.begin()
            from_ns, error = self.from_ns, ""
            frame = yield from frame_in(incoming)
            call = self._calls.get(frame.stream_id)
            ends = "END_STREAM" in frame.flags
            if isinstance(frame, HeadersFrame):
                fields = dict(decoder.decode((yield from block_in(frame, incoming)), raw=True))
                if up and b":path" in fields:
                    call = self._called(frame.stream_id, fields[b":path"], from_ns)
                error = ERRORS.get(fields.get(b"grpc-status", b"0"), "gRPC error")
            elif isinstance(frame, DataFrame) and call and frame.data:
                (call.up if up else call.down)(frame.data, from_ns, self.to_ns)
            elif isinstance(frame, RstStreamFrame):
                self._over(frame.stream_id, f"{'client' if up else 'server'} reset the call ({frame.error_code})")
            elif isinstance(frame, PingFrame):
                self.pings += "ACK" not in frame.flags
            if ends and call:
                call.whole = True
                if not up:
                    call.down(b"", from_ns, self.to_ns)
                    self._over(frame.stream_id, error)

    def _called(self, stream: int, path: bytes, from_ns: int) -> SeenCall:
        name = "".join(filter(str.isprintable, path.decode(errors="replace")))[:LETTERS]
        self._calls[stream] = call = SeenCall(Seen(f"grpc {name}", from_ns), self.piece)
        self.fresh(call.seen)
        if len(self._calls) > MOST_WAITING:
            raise ValueError(f"more than {MOST_WAITING} calls without an answer")
        if call.seen.what == SEND:
            self._observations.append(call)
        return call

    def _over(self, stream: int, error: str) -> None:
        """End a call, and report of its exchange."""
        call = self._calls.pop(stream, None)
        if call is None:
            return
        call.seen.error = error
        if len(call.seen.pieces_ns) == 1:  # an answer in one message is not a stream
            call.seen.pieces_ns.clear()
        if call.seen.what == GET and (error or call.seen.down_bytes > PREFIX):
            self._got(call)
        elif call.seen.what == SEND and error and call in self._observations:
            self._observations.remove(call)
            self._lerobot(call.seen, Seen("", 0, error=error))
        elif call.seen.what not in (SEND, GET):
            self.report(call.seen)

    def _got(self, call: SeenCall) -> None:
        """Report an observation with its chunk, or the error in place of one."""
        its = [each for each in self._observations if each.whole][-1:]
        with suppress(RequestFailed):
            stamp, actions = chunk_in(bytes_in(call.chunk))
            call.seen.chunk = len(actions), actions[0].size
            time = b"G" + struct.pack(">d", stamp)  # as pickles have it
            its = [each for each in self._observations if time in each.head] or its
        if its:
            while self._observations.popleft() is not its[-1]:
                pass
            self._lerobot(its[-1].seen, call.seen)

    def _lerobot(self, sent: Seen, got: Seen) -> None:
        what = f"grpc {LEROBOT}"
        self.report(replace(got, what=what, request_ns=sent.request_ns, sent_ns=sent.sent_ns, up_bytes=sent.up_bytes))

    def end(self) -> None:
        for stream in [*self._calls]:
            self._over(stream, "the connection ended before the answer")


def frame_in(incoming: Incoming) -> Generator[None, None, Frame]:
    frame, size = Frame.parse_frame_header(memoryview((yield from incoming.read(9))))
    frame.parse_body(memoryview((yield from incoming.read(size))))
    return frame


def block_in(frame: Frame, incoming: Incoming) -> Generator[None, None, bytes]:
    """Return a block of headers, which goes on in the next frames."""
    block = b""
    while isinstance(frame, HeadersFrame | ContinuationFrame) and len(block) <= HEADERS_BYTES:
        block += frame.data
        if "END_HEADERS" in frame.flags:
            return block
        frame = yield from frame_in(incoming)
    raise ValueError("headers that do not end")
