"""openpi's protocol as a tap sees it: a handshake of HTTP, then messages, which are requests and answers in turn.

Sizes are those of messages, without frames' heads. Of compressed ones they are all that is read, besides times.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import isfinite
from typing import Any, Final

from websockets.extensions import Extension
from websockets.frames import CTRL_OPCODES, Frame, Opcode

from s2a_bench.errors import RequestFailed
from s2a_bench.facts import INFER_MS
from s2a_bench.plugins.policy_servers.websocket import codec
from s2a_bench.transport.http.tap import HttpReader, chunk_of, loaded
from s2a_bench.transport.tap import DECODED_BYTES, FAILED, MOST_BYTES, Incoming, Seen

CONTROL_BYTES: Final = 125
"""The most that a control frame has (RFC 6455, 5.5), and the longest head of any."""


class Unread(Extension):
    """Stands for the extensions of a connection, whose messages are not read."""

    def decode(self, frame: Frame, *, max_size: int | None = None) -> Frame:  # noqa: ARG002
        return replace(frame, rsv1=False, rsv2=False, rsv3=False)


class WebsocketReader(HttpReader):
    _sent: Incoming | None = None
    _came: Incoming | None = None
    _in_text = False

    def upgraded(self, headers: Mapping[str, str]) -> None:
        self._what = f"websocket {self._waiting.popleft().what.partition(' ')[2]}"
        self._extensions = [Unread()] if "sec-websocket-extensions" in headers else []
        self._sent = Incoming(lambda incoming: self._messages(incoming, up=True))
        self._came = Incoming(lambda incoming: self._messages(incoming, up=False))

    def up(self, data: bytes) -> None:
        (self._sent.feed if self._sent else super().up)(data)

    def down(self, data: bytes) -> None:
        (self._came.feed if self._came else super().down)(data)

    def _messages(self, incoming: Incoming, *, up: bool) -> Generator[None, None, None]:
        seen, size, data, text = None, 0, bytearray(), False
        while True:
            opcode = (yield from incoming.begin()) & 15
            if opcode in {Opcode.TEXT, Opcode.BINARY}:
                seen, size, data = self.begin_request(self._what) if up else self.begin_answer(), 0, bytearray()
                text = opcode == Opcode.TEXT
            wanted = seen and not self._extensions and (not up or self._what not in self._kinds)
            most = (MOST_BYTES if up else DECODED_BYTES) - len(data) if wanted else 0
            frame, length = yield from _frame(incoming, max(most, CONTROL_BYTES), self._extensions, mask=up)
            if frame.opcode in CTRL_OPCODES:
                self.pings += frame.opcode is Opcode.PING
                continue
            size += length
            data += frame.data if wanted else b""
            if up and seen:
                seen.up_bytes = size
            if frame.fin and seen:
                value = _decoded(bytes(data), text=text) if wanted and len(data) == size else None
                (self._request if up else self._answer)(seen, size, value, text=text)
                seen = None

    def _request(self, seen: Seen, size: int, value: Any, *, text: bool) -> None:
        if not size:  # some clients keep a connection open with empty messages, which have no answer
            self.pings += 1
            self._waiting.remove(seen)
            return
        self.fresh(seen)
        self._in_text = text
        seen.observation = value
        self.end_request(seen, size)

    def _answer(self, seen: Seen, size: int, answer: Any, *, text: bool) -> None:
        seen.down_bytes += size
        fields = answer if isinstance(answer, dict) else {}
        kind = str(fields.get(codec.TYPE, ""))
        if chunk := chunk_of(answer):
            before = seen.chunk[0] if kind == codec.PARTIAL and seen.chunk else 0
            seen.chunk = before + chunk[0], chunk[1]
        with suppress(KeyError, TypeError, ValueError):
            infer_ms = float(fields[codec.TIMING][str(INFER_MS)])
            seen.infer_ms = infer_ms if isfinite(infer_ms) else None
        traceback = text and not self._in_text  # as openpi sends it
        seen.error = FAILED * (traceback or kind == codec.ERROR or isinstance(fields.get(codec.ERROR), (str, dict)))
        if kind == codec.PARTIAL and not seen.error:
            self.piece(seen)
        else:
            self.end_answer(seen, seen.down_bytes)


def _frame(
    incoming: Incoming, most: int, extensions: Sequence[Extension], *, mask: bool
) -> Generator[None, None, tuple[Frame, int]]:
    """Read a frame, and the length of its data, which are dropped if they are more than ``most`` bytes."""
    length = 0

    def read(size: int) -> Generator[None, None, bytes]:
        nonlocal length
        length = size
        if size <= most:
            return (yield from incoming.read(size))
        yield from incoming.skip(size)
        return b""

    frame = yield from Frame.parse(read, mask=mask, extensions=extensions)
    return frame, length


def _decoded(data: bytes, *, text: bool) -> Any:
    """Read a message: MessagePack, or a text, which may be JSON; None for bytes that are not a message."""
    if text:
        return loaded(data)
    with suppress(RequestFailed):
        return codec.unpackb(data)
    return None
