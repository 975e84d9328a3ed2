"""What passes between a client and a server of the transport `toy`, for `s2a-bench watch`."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator

from s2a_bench.transport.tap import Incoming, TapReader, Seen
from s2a_toy.wire import LENGTH


class ToyReader(TapReader):
    """A request is a message, its answer a message a token and one that ends it."""

    def __init__(self, report: Callable[[Seen], None], known: set[str]) -> None:
        """Wait for the first bytes of both sides."""
        super().__init__(report, known)
        self._up, self._down = Incoming(self._requests), Incoming(self._answers)

    def up(self, data: bytes) -> None:
        """Read bytes of the client."""
        self._up.feed(data)

    def down(self, data: bytes) -> None:
        """Read bytes of the server."""
        self._down.feed(data)

    def _requests(self, incoming: Incoming) -> Generator[None, None, None]:
        while True:
            yield from incoming.begin()
            seen = self.begin_request("toy")
            (length,) = LENGTH.unpack((yield from incoming.read(LENGTH.size)))
            yield from incoming.skip(length)
            self.end_request(seen, LENGTH.size + length)

    def _answers(self, incoming: Incoming) -> Generator[None, None, None]:
        size = 0
        while True:
            yield from incoming.begin()
            seen = self.begin_answer()
            (length,) = LENGTH.unpack((yield from incoming.read(LENGTH.size)))
            message = json.loads((yield from incoming.read(length)))
            size += LENGTH.size + length
            if seen and "index" in message:
                seen.pieces_ns.append(self.to_ns)
            elif seen:
                seen.error = str(message.get("error", ""))
                self.end_answer(seen, size)
                size = 0
