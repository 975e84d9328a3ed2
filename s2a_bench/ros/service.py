"""Plain ROS 2 services on any middleware: both ends of one, how a node answers requests from outside, how all wait."""

from __future__ import annotations

import atexit
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from threading import Thread
from typing import Any, Final, Generic, Protocol, TypeVar

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import SERVICE_QOS, Publisher, QoS, Subscription
from s2a_bench.ros.messages import DEFAULT_VERSION

WAIT_SLICE_NS: Final = 500_000_000
"""A blocked wait returns to Python this often, so that Ctrl-C acts."""
AT_ONCE: Final = 1000
"""The most messages that are taken before they are looked at."""
READER_QOS: Final = QoS(depth=0)
"""Our readers keep all, whatever ROS does: history is local, and a burst overruns ROS's default of 10."""
MATCH_POLL_S: Final = 0.01
"""rclpy's own waiting looks four times a second."""
REACH_S: Final = 0.1
"""A server waits so long for the reader of a client that it does not reach yet, as rmw_cyclonedds does."""
WARNED_AT_MOST: Final = 100
"""Kinds of a warning that are logged: the errors of a camera's frames may differ in each."""

_log = logging.getLogger(__name__)
Taken = TypeVar("Taken")
Caller = TypeVar("Caller")
"""The data with which a middleware addresses the reply to a request."""


class Waits(Protocol):
    interrupted: bool

    def wait_until(self, deadline_ns: int, /) -> bool:
        """Return after data, a time slice or an interrupt; False once the deadline or an interrupt has come."""

    def interrupt(self) -> None:
        """End a wait under way and every later one; callable from any thread."""


Waiter = TypeVar("Waiter", bound=Waits)


def appeared(present: Callable[[], bool], timeout_s: float, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Poll ``present`` every 10 ms; False after ``timeout_s``, or once ``given_up`` is True."""
    deadline_ns = now_ns() + int(timeout_s * 1e9)
    while not present():
        if now_ns() > deadline_ns or given_up():
            return False
        time.sleep(MATCH_POLL_S)
    return True


def awaited(take: Callable[[], Taken], waiter: Waits, timeout_s: float) -> Taken | None:
    """Return the result of ``take`` as soon as it has one; None after the time, or an interrupt."""
    deadline_ns = now_ns() + int(timeout_s * 1e9)
    while not waiter.interrupted:
        if (taken := take()) is not None or not waiter.wait_until(deadline_ns):
            return taken
    return None


@dataclass(frozen=True, slots=True)
class ServiceSpec:
    """The service ``/name`` of ROS type ``pkg/srv/Name``, with ``version`` as in `messages.VERSIONS`."""

    name: str
    type_name: str
    version: str = DEFAULT_VERSION

    @property
    def request_type(self) -> str:
        return self.type_name + "_Request"

    @property
    def reply_type(self) -> str:
        return self.type_name + "_Response"


class End(Protocol):
    spec: ServiceSpec
    body_at: int
    """The offset of bodies in the CDR."""

    @property
    def hashed_type(self) -> str:
        """Return the type whose hash is announced."""
        return self.spec.type_name

    def pack(self, body: Any, /) -> bytearray: ...

    def unpack(self, packed: memoryview, /) -> Any:
        """Deserialise a message of the other side; raises TransportError."""


class ServiceEnd(End, Protocol[Caller]):
    def arrived(self) -> Iterator[tuple[memoryview, Caller]]:
        """Take the requests that have arrived, a bounded number: CDR and caller."""

    def respond(self, packed: bytearray, caller: Caller, /) -> None: ...

    def reaches(self, caller: Caller, /) -> bool:  # noqa: ARG002 - for ends whose replies need discovery
        """Wait, 100 ms at most, until replies reach the caller; False if it has left."""
        return True

    def drop(self, caller: Caller, /) -> None:  # noqa: ARG002 - for ends that keep them
        """Release a request, which may have been answered."""
        return

    def client(self, caller: Caller, /) -> tuple[str, str]:  # noqa: ARG002 - for ends that know
        """Return a client's DDS, if replies cannot reach it, and the type hash it announces; "" where unknown."""
        return "", ""

    def unreached(self) -> Iterable[str]:
        """Return the type hashes of clients of other versions, whose requests do not arrive."""
        return ()


class ClientEnd(End, Protocol):
    def call(self, packed: bytearray, key: bytes, /) -> None:
        """Send a request, to which ``key`` belongs: a goal's id, where it concerns one."""

    def replies(self) -> Iterator[tuple[bytes, memoryview | None]]:
        """Take the replies that have arrived, a bounded number: key, and CDR, None where the request was dropped."""

    def matched(self) -> bool: ...

    def peer_type_hash(self) -> str:
        """Return the type hash that a server announces; empty without one."""

    def other_dds(self) -> str:
        """Return the DDS of a server whose services have another form, "" without one."""
        return ""


class Source(Subscription, Protocol):
    """A subscription without a thread that waits for it."""

    def arrived(self) -> Iterable[memoryview]:
        """Take the messages that have arrived, `AT_ONCE` at most."""

    def announced(self) -> int:
        """Count the publishers, those of other versions too."""


class LogOnce:
    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._kinds: set[str] = set()

    def warning(self, kind: str, message: str, *values: Any) -> None:
        """Log the first message of a ``kind``, of `WARNED_AT_MOST` kinds."""
        if kind not in self._kinds and len(self._kinds) < WARNED_AT_MOST:
            self._kinds.add(kind)
            self._log.warning(message, *values)


class Calling:
    def __init__(self, client: ClientEnd, waiter: Waits) -> None:
        self._client, self._waiter, self._calls = client, waiter, 0

    def call(self, request: Any, timeout_s: float) -> Any:
        deadline_ns, name = now_ns() + int(timeout_s * 1e9), self._client.spec.name
        if not appeared(self._client.matched, timeout_s):
            raise TransportError(f"no server of the service {name} appeared in {timeout_s:g} s")
        self._calls += 1
        key = self._calls.to_bytes(8, "big")
        self._client.call(self._client.pack(request), key)
        silent = f"the service {name} did not answer in {timeout_s:g} s"
        while True:
            for answered, packed in self._client.replies():
                if answered == key:
                    if packed is None:
                        raise TransportError(f"{silent}: it has dropped the request")
                    return self._client.unpack(packed)
            if not self._waiter.wait_until(deadline_ns):
                raise TransportError(silent)


class ServiceNode(ABC, Generic[Caller, Waiter]):
    """One node whose services are built from a middleware's endpoints, each announced when it is made.

    One thread answers all services.
    """

    def __init__(self) -> None:
        self._offered: dict[str, tuple[ServiceEnd[Caller], Callable[[Any], Any]]] = {}
        self._serving: Thread | None = None
        self._once = LogOnce(_log)
        self._servers: list[Any] = []
        self._closed = False
        atexit.register(self.close)  # a node that does not leave is seen until its lease ends

    @abstractmethod
    def waiter(self) -> Waiter:
        """Return an object that waits for the endpoints that are made with it."""

    @abstractmethod
    def publisher(self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION) -> Publisher: ...

    @abstractmethod
    def subscription(
        self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION, waiter: Waiter | None = None
    ) -> Source: ...

    @abstractmethod
    def service_end(self, spec: ServiceSpec, waiter: Waiter, qos: QoS | None = None) -> ServiceEnd[Caller]:
        """Make the server's side, without ``qos`` as an action's."""

    @abstractmethod
    def client_end(self, spec: ServiceSpec, waiter: Waiter) -> ClientEnd: ...

    @abstractmethod
    def leave(self) -> None:
        """Leave the domain, which tells peers at once."""

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Create a service; the first starts the thread."""
        self.check_open()
        if self._serving is None:
            self._requests = self.waiter()
            self._serving = Thread(target=self._serve, name="services", daemon=True)
            self._serving.start()
        end = self.service_end(ServiceSpec(name, type_name), self._requests, qos)
        self._offered = {**self._offered, name: (end, answer)}  # while the thread goes through the old ones

    def _serve(self) -> None:
        while not self._requests.interrupted:
            for name, (service, answer) in self._offered.items():
                for packed, caller in service.arrived():
                    self._handle(name, service, answer, packed, caller)
                    service.drop(caller)
            self._requests.wait_until(now_ns() + WAIT_SLICE_NS)

    def _handle(
        self, name: str, service: ServiceEnd[Caller], answer: Callable[[Any], Any], packed: memoryview, caller: Caller
    ) -> None:
        """Answer one request, unless its client has left; what cannot be answered is dropped."""
        try:
            if len(packed) <= service.body_at:
                raise TransportError(f"{len(packed)} bytes are not a request")
            response = service.pack(answer(service.unpack(packed)))
            if service.reaches(caller):
                service.respond(response, caller)
        except Exception as error:  # noqa: BLE001 - the server survives a bad request
            kind = f"{name} {type(error).__name__}"  # not its text, which a client can vary each time
            self._once.warning(kind, "%s: dropped a request: %s", name, str(error)[:200])

    def service_client(self, name: str, type_name: str) -> Calling:
        waiter = self.waiter()
        return Calling(self.client_end(ServiceSpec(name, type_name), waiter), waiter)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            atexit.unregister(self.close)
            for server in self._servers:
                server.close()
            if self._serving is not None:
                self._requests.interrupt()
                self._serving.join()
            self.leave()

    def check_open(self) -> None:
        if self._closed:
            raise TransportError("the middleware is closed")
