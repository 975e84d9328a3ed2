"""ROS 2 without a ROS install: a Middleware publishes and subscribes under ROS 2 names and types.

Messages are instances of the rosbags classes in `s2a_bench.ros.messages`, whatever the implementation sends.
Packing and sending are two calls, and so are taking and unpacking, because the harness times them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Literal, Protocol, TypeAlias

from s2a_bench.errors import TransportError, UsageError

Tuning: TypeAlias = Literal["tuned", "default"]


@dataclass(frozen=True, slots=True)
class QoS:
    """The quality of service settings ROS 2 users know; `depth` 0 keeps all."""

    depth: int = 10
    reliable: bool = True


class Publisher(Protocol):
    """Sends messages of one type to one topic."""

    def pack(self, message: Any) -> Any:
        """Serialise a message into what `send` takes."""
        ...

    def send(self, packed: Any) -> None:
        """Hand a packed message to the middleware; raises TransportError."""
        ...

    def matched(self) -> int:
        """Count the subscriptions this publisher reaches."""
        ...


class Subscription(Protocol):
    """Receives messages of one type from one topic, on the thread that calls `take`."""

    def take(self, timeout_s: float) -> Any | None:
        """Wait for the next message and return it packed; None on timeout or after `interrupt`."""
        ...

    def unpack(self, packed: Any) -> Any:
        """Deserialise; arrays may be read-only views of the received buffer. Raises TransportError."""
        ...

    def interrupt(self) -> None:
        """Make a blocked `take`, and every later one, return None; callable from any thread."""
        ...

    def matched(self) -> int:
        """Count the publishers that reach this subscription."""
        ...


class Middleware(Protocol):
    """One participant in a ROS 2 domain. Action client and server join the contract with the action interface."""

    def publisher(self, topic: str, type_name: str, qos: QoS) -> Publisher:
        """Publish messages of ROS type ``pkg/msg/Name`` on the absolute ROS topic name ``/x``."""
        ...

    def subscription(self, topic: str, type_name: str, qos: QoS) -> Subscription:
        """Subscribe to the absolute ROS topic name ``/x``."""
        ...

    def describe(self) -> dict[str, str | int]:
        """Say what carries the messages: implementation, version, domain, configuration."""
        ...

    def close(self) -> None:
        """Leave the domain at once, so that peers need not wait for the lease; may be called twice."""
        ...


MIDDLEWARES: dict[str, str] = {
    "cyclonedds": "s2a_bench.ros.cyclone:CycloneMiddleware",
}
"""Name -> class, built as ``Class(domain_id, tuning)``."""


def open_middleware(name: str = "cyclonedds", *, domain_id: int = 0, tuning: Tuning = "tuned") -> Middleware:
    """Join a ROS 2 domain; raises UsageError for an unknown name, TransportError when it cannot be joined."""
    if name not in MIDDLEWARES:
        raise UsageError(f"middleware: '{name}' is none of {', '.join(MIDDLEWARES)}")
    try:
        implementation = resolve_name(MIDDLEWARES[name])
    except ModuleNotFoundError as error:
        raise TransportError(
            f"middleware {name} is not installed ({error}); cyclonedds has wheels for x86-64 only: "
            "build it from source, or leave ros out of --transport"
        ) from error
    middleware: Middleware = implementation(domain_id, tuning)
    return middleware
