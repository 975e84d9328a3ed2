"""The ROS server: fronts receive requests, handlers answer them, the camera's newest frame is at hand.

A front is one variant's way in. Its threads take turns in waiting for a request; the one that got it answers it
while another waits, so that no request changes threads, and one that comes meanwhile waits for the engine (stage
`queue`), not in the network.
"""

from __future__ import annotations

import sys
from threading import Event, Lock, Thread
from typing import Any, Protocol

from s2a_bench.trace import Trace
from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.ros.action import ActionFront
from s2a_bench.transport.ros.camera import POLL_S, CameraCache
from s2a_bench.transport.ros.joining import join, namespace_of, refuse_company
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.topic import TopicFront
from s2a_bench.types import Request, Token


class Job(Protocol):
    """One request on its way to the engine and back."""

    trace: Trace
    request: Request | None
    """None where it could not be prepared; then only `end` is called."""

    def token(self, token: Token) -> bool:
        """Send a token; return whether more are wanted."""
        ...

    def end(self, error: str = "") -> None:
        """Send the end of the answer."""
        ...


class Front(Protocol):
    """One variant's way in."""

    def take(self, timeout_s: float) -> Any | None:
        """Wait for the next request and return it packed; None on timeout or after `interrupt`."""
        ...

    def job(self, packed: Any, trace: Trace) -> Job | None:
        """Unpack and prepare a request, marking each stage; None for what is none."""
        ...

    def interrupt(self) -> None:
        """Make `take` return, callable from any thread."""
        ...


WORKERS = 4
"""Threads a front: requests that can wait for the engine at a time, and one that receives."""


class RosServer:
    """Answers the requests of all fronts."""

    def __init__(self, wiring: Wiring[RosOptions], handler: Handler) -> None:
        """Join the domain and create all topics; raises TransportError where another server answers already."""
        self.address = namespace_of(wiring)
        self._handler = handler
        refuse_company(wiring, self.address)
        self.middleware = join(wiring, "server")
        self._cache = CameraCache(self.middleware, self.address, wiring.options.qos)
        self._fronts: list[Front] = [
            TopicFront(self.middleware, self.address, self._cache),
            ActionFront(self.middleware, wiring, self._cache),
        ]
        self._stopped = Event()

    def serve(self) -> None:
        """Serve until stopped."""
        turns = [(front, Lock()) for front in self._fronts]
        threads = [Thread(target=self._work, args=turn, daemon=True) for turn in turns for _ in range(WORKERS)]
        self._cache.start()
        for thread in threads:
            thread.start()
        self._stopped.wait()
        for thread in threads:
            thread.join()
        self._cache.join()
        self.middleware.close()

    def stop(self) -> None:
        """Wake all threads."""
        self._stopped.set()
        for front in self._fronts:
            front.interrupt()
        self._cache.interrupt()

    def describe(self) -> dict[str, str | int]:
        """Say what carries the messages."""
        return self.middleware.describe()

    def _work(self, front: Front, turn: Lock) -> None:
        """Wait for a request when it is this thread's turn, and answer it while another thread waits."""
        while not self._stopped.is_set():
            job = packed = None  # gives the received bytes back before the next wait
            try:
                with turn:
                    packed = front.take(POLL_S)
                    trace = Trace()
                    trace.mark("network")
                job = front.job(packed, trace) if packed is not None else None
                if job is not None:
                    self._answer(job)
            except Exception as error:  # noqa: BLE001 - a node stays up: the next request may fare better
                said = f"request not answered: {error or type(error).__name__}"
                print(said, file=sys.stderr, flush=True)  # noqa: T201 - a node's log

    def _answer(self, job: Job) -> None:
        """Answer one request; what goes wrong goes back to who asked."""
        if job.request is None or self._stopped.is_set():
            job.end("the server is stopping" if job.request else "")
            return
        error = ""
        tokens = self._handler(job.request, job.trace)
        try:
            for token in tokens:
                if self._stopped.is_set():
                    error = "the server is stopping"
                if error or not job.token(token):
                    break
        except Exception as failure:  # noqa: BLE001 - who asked must hear of it, whatever broke
            error = str(failure) or type(failure).__name__
        finally:
            tokens.close()
        job.end(error)
