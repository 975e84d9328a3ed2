"""The ROS server: fronts receive requests, one thread asks the engine, the camera's newest frame is at hand.

A front is one variant's way in. Each has a thread that waits for requests and prepares them, so that the time a request
waits for the engine is its own stage, `queue`, and not taken for network.
"""

from __future__ import annotations

from queue import SimpleQueue
from threading import Lock, Thread
from typing import Protocol

from s2a_bench.errors import S2AError
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Handler, Route
from s2a_bench.transport.ros.camera import POLL_S, CameraCache
from s2a_bench.transport.ros.joining import DEFAULT_NAMESPACE, join, refuse_company
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

    def next_job(self, timeout_s: float) -> Job | None:
        """Wait for the next request and prepare it."""
        ...

    def interrupt(self) -> None:
        """Make `next_job` return, callable from any thread."""
        ...


class RosServer:
    """Answers the requests of all fronts, one after the other, on the thread that calls `serve`."""

    def __init__(self, route: Route, handler: Handler) -> None:
        """Join the domain and create all topics; raises TransportError where another server answers already."""
        self.address = route.address or DEFAULT_NAMESPACE
        self._handler = handler
        refuse_company(route, self.address)
        self.middleware = join(route)
        self._cache = CameraCache(self.middleware, self.address)
        self._fronts: list[Front] = [TopicFront(self.middleware, self.address, self._cache)]
        self._jobs: SimpleQueue[tuple[Job, bool] | None] = SimpleQueue()
        self._waiting = 0
        self._lock = Lock()
        self._stopped = False

    def serve(self) -> None:
        """Serve until stopped."""
        threads = [Thread(target=self._receive, args=(front,), daemon=True) for front in self._fronts]
        self._cache.start()
        for thread in threads:
            thread.start()
        while (item := self._jobs.get()) is not None:
            job, waited = item
            job.trace.mark("queue" if waited else RESIDUAL)
            self._answer(job)
            with self._lock:
                self._waiting -= 1
            del job, item  # gives the received bytes back before the next wait
        for thread in threads:
            thread.join()
        self._cache.join()
        self.middleware.close()

    def stop(self) -> None:
        """Wake all threads."""
        self._stopped = True
        self._jobs.put(None)
        for front in self._fronts:
            front.interrupt()
        self._cache.interrupt()

    def describe(self) -> dict[str, str | int]:
        """Say what carries the messages."""
        return self.middleware.describe()

    def _receive(self, front: Front) -> None:
        """Hand one front's requests to the engine's thread."""
        while not self._stopped:
            job = front.next_job(POLL_S)
            if job is not None:
                with self._lock:
                    waited = self._waiting > 0
                    self._waiting += 1
                self._jobs.put((job, waited))
                del job

    def _answer(self, job: Job) -> None:
        """Answer one request; what goes wrong goes back to who asked."""
        if job.request is None:
            job.end()
            return
        tokens = self._handler(job.request, job.trace)
        try:
            for token in tokens:
                if not job.token(token):
                    tokens.close()
                    break
        except S2AError as error:
            job.end(str(error))
        else:
            job.end()
