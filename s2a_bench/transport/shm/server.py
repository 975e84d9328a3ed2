"""The server: a thread for each link reads a request where it lies, waits for its turn, and writes the pieces."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock, Thread
from typing import Final

from s2a_bench.errors import EngineError, S2AError, TransportError
from s2a_bench.trace import RESIDUAL, Remote, Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.shm import ShmOptions
from s2a_bench.transport.shm.door import listen, may_ask, wait_at_most
from s2a_bench.transport.shm.memory import ANSWER_BYTES, PICTURES_AT, PLACE, Memory, accept, offer, refuse
from s2a_bench.transport.shm.pieces import packed
from s2a_bench.transport.shm.reading import Header, Held
from s2a_bench.transport.shm.ring import PIECE_BYTES, Writer, is_there
from s2a_bench.transport.turns import Queued, Turn

PAUSE_S: Final = 0.1
"""Before the next link is taken, where one could not be: the limit of open files, or of threads, is met."""

_log = logging.getLogger(__name__)


class ShmServer:
    """Answers the clients of one user on one machine."""

    def __init__(self, wiring: Wiring[ShmOptions], handler: Handler) -> None:
        """Bind; raises PortInUse, TransportError."""
        self._limits = wiring.limits
        self._queued = Queued.around(handler, wiring.limits)
        self._held = Held(wiring.limits)
        self._listener = listen(wiring.address)
        self.address = self._listener.getsockname()
        self._lock, self._links, self._stopped = Lock(), set[socket.socket](), False

    def describe(self) -> dict[str, str | int]:
        """Return what carries the requests."""
        return {"server": "shared memory (memfd), Unix socket"}

    def serve(self) -> None:
        """Serve until stopped."""
        while not self._stopped:
            try:
                link, _ = self._listener.accept()
            except OSError as error:
                if not self._stopped:
                    _log.warning("no link can be taken: %s", error)
                    time.sleep(PAUSE_S)
                continue
            try:
                Thread(target=self._answer_all, args=(link,), name="shm link", daemon=True).start()
            except RuntimeError as error:
                _log.warning("no link can be taken: %s", error)
                link.close()
                time.sleep(PAUSE_S)

    def stop(self) -> None:
        """Stop listening, and end every link."""
        if not self._stopped:
            with suppress(OSError):
                Path(self.address).unlink()  # while it is ours
        self._stopped = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            links = list(self._links)
        for link in links:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)

    def _answer_all(self, link: socket.socket) -> None:
        """Welcome a client, and answer one request after the other."""
        try:
            with link, self._counted(link):
                try:
                    requests, writer = self._welcome(link)
                except TransportError as error:
                    refuse(link, str(error))
                    raise
                while packet := link.recv(PLACE.size + 1):
                    trace = Trace()
                    trace.mark("network")
                    if len(packet) != PLACE.size:
                        raise TransportError(f"a packet of {len(packet)} bytes is none of a request")
                    self._answer(link, requests, writer, PLACE.unpack(packet), trace)
        except (OSError, EOFError):
            pass  # the client has gone
        except TransportError as error:
            _log.warning("a link was closed: %s", error)

    @contextmanager
    def _counted(self, link: socket.socket) -> Iterator[None]:
        """Know a link for as long as it lasts."""
        with self._lock:
            self._links.add(link)
        try:
            yield
        finally:
            with self._lock:
                self._links.discard(link)

    def _welcome(self, link: socket.socket) -> tuple[Memory, Writer]:
        """Exchange memory; raises TransportError for who is none of ours."""
        wait_at_most(link, self._limits.head_s)
        if not may_ask(link):
            raise TransportError("this server answers its own user only")
        if self._stopped or len(self._links) > self._limits.connections:
            raise TransportError(f"{self._limits.connections} links are open already")
        requests = accept(link, PICTURES_AT + self._limits.body_bytes)
        writer = Writer(link, offer(link, ANSWER_BYTES), requests)
        wait_at_most(link, 0)
        return requests, writer

    def _answer(
        self, link: socket.socket, requests: Memory, writer: Writer, place: tuple[int, int], trace: Trace
    ) -> None:
        """Read a request, wait for its turn, write the answer; raises OSError where the client has gone."""
        turn: Turn | None = None
        held = 0
        said: Remote | str
        writer.begin()
        try:
            held = self._held.take(requests, *place)
            header = Header.read(requests, *place, self._limits)
            trace.mark("header_parse")
            turn = self._queued.turns.join()
            request = header.request(requests, trace)
            if turn.come is not None:
                trace.mark(RESIDUAL)
                if not turn.wait(lambda: not is_there(link)):
                    raise ConnectionAbortedError
                trace.mark("queue")
            tokens = self._queued.answer(request, trace, turn)
            try:
                for token in tokens:
                    writer.send(packed(token))
            finally:
                tokens.close()
            said = trace.to_remote()
        except S2AError as error:
            said = str(error)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - who asked must hear of it, whatever broke
            _log.error("a request failed", exc_info=error)
            said = str(EngineError("Internal Server Error"))
        finally:
            self._held.give_back(held)
            if turn is not None:
                turn.leave()
        end = packed(said)
        writer.send(end if len(end) <= PIECE_BYTES else packed(f"{len(end)} bytes of marks: too long an answer"))
        writer.finish(turn.left_s if turn is not None else lambda: self._limits.answer_s)
