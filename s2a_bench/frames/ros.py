"""A ROS 2 topic as a camera, with or without a ROS install: over any of our middlewares."""

from __future__ import annotations

from threading import Condition, Thread
from typing import Any, ClassVar, Final

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.frames.messages import TYPES, ImageMessages
from s2a_bench.policy.parameters import build
from s2a_bench.ros import Offer, QoS
from s2a_bench.ros.join import RosParameters
from s2a_bench.ros.remap import ABSOLUTE
from s2a_bench.ros.service import appeared
from s2a_bench.types import Frame, Pixels

POLL_S: Final = 0.5


class TopicCamera(ImageMessages):
    """A topic of sensor_msgs/Image or CompressedImage; the subscription is reliable if all its publishers are.

    ``/topic?middleware=...`` has `RosParameters`; for ``wait_s`` a publisher is waited for, and each picture.
    read() returns the newest picture, one time; ``stamp_ns`` is when it was received.
    """

    where: ClassVar[str] = "/TOPIC"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        super().__init__(f"ros:{where}", width, height)
        self._topic = where.partition("?")[0]
        if not ABSOLUTE.fullmatch(self._topic):
            raise UsageError(f"`source`: '{self.name}' should look like ros:/camera/image_raw, from the root")
        how = build(RosParameters, self.name, "source")
        self._wait_s = how.wait_s
        self._changed = Condition()
        self._middleware: Any = None
        self._newest: tuple[Any, int] | TransportError | None = None
        self._thread = Thread(target=self._receive, name="topic", daemon=True)
        try:
            with self.errors():
                self._middleware = how.join("/s2a_bench/source", lambda node: node)
                offers = self._offers()
                qos = QoS(depth=1, reliable=all(offer.reliable for offer in offers))
                self._subscription = self._middleware.subscription(self._topic, offers[0].type_name, qos)
                self._thread.start()
                self.begin(self._subscription.unpack(self._wait()[0]))
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame:
        with self.errors():
            return super().read()

    def close(self) -> None:
        super().close()
        if self._thread.is_alive():
            self._subscription.interrupt()
            self._thread.join()
        if self._middleware:
            self._middleware.close()

    def _grab(self) -> int:
        with self._changed:
            self._packed, stamp_ns = self._wait()
            self._newest = None
        return stamp_ns

    def _picture(self) -> Pixels:
        return self.pixels(self._subscription.unpack(self._packed))

    def _offers(self) -> list[Offer]:
        """Wait for publishers of the topic and return those of pictures, of one type."""
        middleware = self._middleware
        there = appeared(lambda: any(offer.topic == self._topic for offer in middleware.offers()), self._wait_s)
        offered = middleware.offers()
        for type_name in TYPES:
            if offers := [offer for offer in offered if (offer.topic, offer.type_name) == (self._topic, type_name)]:
                return offers
        others = sorted({offer.topic for offer in offered if offer.type_name in TYPES})
        types = sorted({offer.type_name for offer in offered if offer.topic == self._topic})
        listed = f"topics of pictures here: {', '.join(others[:10]) or 'none'}"
        if there:
            raise TransportError(f"{self._topic} is of type {', '.join(types)}; {listed}")
        raise TransportError(unpublished(self._topic, self._wait_s, listed, f"the {self.option}"))

    def _receive(self) -> None:
        while not self._closed:
            newest: tuple[Any, int] | TransportError | None = None
            try:
                if packed := self._subscription.take(POLL_S):
                    newest = packed, now_ns()
            except TransportError as error:
                newest = error
            with self._changed:
                self._newest = newest or self._newest
                self._changed.notify_all()
            if isinstance(newest, TransportError):
                break

    def _wait(self) -> tuple[Any, int]:
        """Wait for a message that was not read yet; return it packed, and when it was received."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest, self._wait_s)
            newest = self._newest
        if isinstance(newest, TransportError):
            raise newest
        if newest is None:
            count = self._subscription.matched()
            what = f"no picture for {self._wait_s:g} s of {count} publisher{'' if count == 1 else 's'}"
            if not count:
                raise TransportError(f"{what}: start it again, or one with the QoS and the type of ROS 2")
            raise TransportError(
                f"{what}; see whether `ros2 topic hz {self._topic}` counts any. Large pictures need larger receive "
                "buffers: `s2a-bench doctor`"
            )
        return newest


def unpublished(topic: str, wait_s: float, listed: str, where: str) -> str:
    """Return the error of a topic without a publisher, with what is there and ``where`` the domain is named."""
    return (
        f"{topic} has no publisher after {wait_s:g} s; {listed}. "
        f"Is ROS_DOMAIN_ID (or `?domain_id=` of {where}) the publisher's, and is "
        "ROS_AUTOMATIC_DISCOVERY_RANGE SUBNET if it is on another host?"
    )
