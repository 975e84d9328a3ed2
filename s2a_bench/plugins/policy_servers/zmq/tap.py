"""Reads the messages of a client and a server of GR00T's protocol: ZMTP 3 (ZeroMQ's RFC 23) and MessagePack.

A message of several frames is one request or answer: the last one is the body, those before it are its envelope. Of a
request only the head is read, for its endpoint, unless it is the first of its kind.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from typing import Final

import msgpack

from s2a_bench.errors import RequestFailed
from s2a_bench.plugins.policy_servers.zmq import layouts
from s2a_bench.plugins.policy_servers.zmq.wire import read
from s2a_bench.transport.tap import DECODED_BYTES, FAILED, MOST_BYTES, Incoming, ParsedTapReader, Seen

MORE, LONG, COMMAND = 1, 2, 4
"""Flags of a frame."""
MECHANISMS: Final = (b"NULL", b"PLAIN")
"""The mechanisms without encryption; CURVE encrypts all that follows."""
PING: Final = b"\x04PING"
HEAD: Final = 512
"""Bytes of a request in which its endpoint stands."""
WHAT, ACT = "zmq", f"zmq {layouts.GET_ACTION}"
NAME: Final = 40
"""Most letters of an endpoint."""


class ZmqReader(ParsedTapReader):
    def messages(self, incoming: Incoming, *, up: bool) -> Generator[None, None, None]:
        """Read the greeting, and then frame after frame, with commands between the frames of a message."""
        if (yield from incoming.begin()) != 0xFF or (yield from incoming.read(10))[9] != 0x7F:  # noqa: PLR2004 - its signature
            raise ValueError("no ZeroMQ")
        greeting = yield from incoming.read(54)
        if greeting[0] < 3 or greeting[2:22].rstrip(b"\0") not in MECHANISMS:  # noqa: PLR2004 - its version
            raise ValueError("ZeroMQ that is encrypted, or older than ZMTP 3")
        seen, total, inside = None, 0, False
        while True:
            flags = (yield from incoming.read(1))[0]
            if not flags & COMMAND and not inside:
                seen, total = (self.begin_request(WHAT) if up else self.begin_answer()), 0
            size = int.from_bytes((yield from incoming.read(8 if flags & LONG else 1)), "big")
            if flags & COMMAND:
                name = yield from incoming.read(min(size, len(PING)))
                self.pings += name == PING
                yield from incoming.skip(size - len(name))
                continue
            inside, total = bool(flags & MORE), total + size
            if inside or seen is None:
                yield from incoming.skip(size)
            elif up:
                yield from self._request(incoming, seen, size)
                self.end_request(seen, total)
            else:
                yield from self._answer(incoming, seen, size)
                self.end_answer(seen, total)

    def _request(self, incoming: Incoming, seen: Seen, size: int) -> Generator[None, None, None]:
        head = yield from incoming.read(min(size, HEAD))
        seen.what = what_in(head)
        if size > MOST_BYTES or not self.fresh(seen):
            yield from incoming.skip(size - len(head))
            return
        rest = yield from incoming.read(size - len(head))
        with suppress(RequestFailed):
            message, _ = read(head + rest)
            seen.observation = message.get(layouts.DATA) if isinstance(message, dict) else None

    def _answer(self, incoming: Incoming, seen: Seen, size: int) -> Generator[None, None, None]:
        if size > DECODED_BYTES:
            yield from incoming.skip(size)
            return
        body = yield from incoming.read(size)
        with suppress(RequestFailed):
            answer = {layouts.ERROR: ""} if body == b"ERROR" else read(body)[0]  # N1.5's, of any exception
            if isinstance(answer, dict) and layouts.ERROR in answer:
                seen.error = FAILED
            elif seen.what == ACT:
                actions = layouts.actions_in(answer)
                seen.chunk = len(actions), len(actions[0].values)


def what_in(head: bytes) -> str:
    """Return the kind of a request, whose map begins with these bytes, by its endpoint."""
    unpacker = msgpack.Unpacker(max_buffer_size=HEAD)
    unpacker.feed(head)
    with suppress(msgpack.UnpackException, ValueError):
        for _ in range(unpacker.read_map_header()):
            if unpacker.unpack() == layouts.ENDPOINT:
                endpoint = str(unpacker.unpack())[:NAME]
                return f"{WHAT} {''.join(filter(str.isprintable, endpoint))}".rstrip()
            unpacker.skip()
    return WHAT
