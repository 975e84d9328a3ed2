"""The camera on ROS 2: frames as ``sensor_msgs`` messages, a publisher of them, and a server's cache of the newest.

The topics are plain ``sensor_msgs/Image`` and CompressedImage, so any ROS 2 subscriber sees them and any ROS 2
camera feeds the cache.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock, Thread
from typing import Any

from s2a_bench.clock import now_ns, realtime_offset_ns
from s2a_bench.errors import RequestFailed, TransportError
from s2a_bench.facts import CAMERA_AGE_MS, CAMERA_FRAMES, CAMERA_SIM_AGE_MS, CAMERA_STAMP_AGE_MS, STALE_FRAMES
from s2a_bench.frames.messages import decompressed
from s2a_bench.ros import Middleware, QoS, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.ros.service import LogOnce, appeared
from s2a_bench.trace import RESIDUAL, Mark, Trace
from s2a_bench.transport.limits import LIMITS, Limits, check_pixels
from s2a_bench.transport.pictures import bgr_of, encoded, rgb_of
from s2a_bench.transport.ros import ROS
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.types import Frame

CAMERA = "/camera/image_raw"
COMPRESSED_CAMERA = "/camera/image_raw/compressed"
FRAME_ID = "camera"
PIXELS = frozenset({"raw", "yuyv"})
"""Payloads that are sensor_msgs/Image; the others are CompressedImage."""
CAMERA_QOS = {"reliable": QoS(depth=1), "sensor_data": QoS(depth=5, reliable=False)}
"""The QoS of ROS 2's profiles, by name; a reliable subscription does not match a best-effort publisher."""
CLOCK, CLOCK_QOS = "/clock", QoS(depth=1, reliable=False)
"""Simulated time, as a simulator or a replayed recording publishes it."""
POLL_S = 0.5
FIRST_FRAME_S = 1.0
"""The longest that a request waits for the first frame of a publisher."""
_log = logging.getLogger(__name__)


def picture_message(frame: Frame, payload: str, offset_ns: int, trace: Trace) -> tuple[str, Any]:
    """Return (ROS type, message) of a frame for a payload; ``offset_ns`` turns its stamp into ROS time."""
    stamp_ns = frame.stamp_ns + offset_ns
    if payload not in PIXELS:
        media_type, data = encoded(frame, payload, trace)
        return ros.COMPRESSED_IMAGE, ros.compressed_image_message(data, stamp_ns, FRAME_ID, media_type[len("image/") :])
    if payload == "yuyv" and frame.encoding != "yuv422_yuy2":
        raise RequestFailed(f"`payload` yuyv: this source delivers {frame.encoding}; use raw")
    return ros.IMAGE, ros.image_message(bgr_of(frame, trace) if payload == "raw" else frame, stamp_ns, FRAME_ID)


def picture_of(message: Any, trace: Trace, most_pixels: int = LIMITS.pixels) -> Frame:
    """Turn a received image message into an RGB frame; its stamp is ROS time. Raises TransportError."""
    if hasattr(message, "format"):
        frame = decompressed(message)
        check_pixels(frame.width, frame.height, most_pixels)
        trace.mark("image_decode")
        return rgb_of(frame, trace)
    check_pixels(message.width, message.height, most_pixels)
    return rgb_of(ros.frame_of_image(message), trace)


def pictures_of(messages: Iterable[Any], trace: Trace, limits: Limits) -> tuple[Frame, ...]:
    """Turn the image messages of one request, which share its pixels, into RGB frames."""
    frames, pixels = list[Frame](), limits.pixels
    for message in messages:
        frames.append(picture_of(message, trace, pixels))
        pixels -= frames[-1].pixel_count
    return tuple(frames)


class CameraPublisher:
    def __init__(self, middleware: Middleware, namespace: str, payload: str, qos: str) -> None:
        self._payload = payload
        self._offset_ns = realtime_offset_ns()
        topic, type_name = (CAMERA, ros.IMAGE) if payload in PIXELS else (COMPRESSED_CAMERA, ros.COMPRESSED_IMAGE)
        self._publisher = middleware.publisher(namespace + topic, type_name, CAMERA_QOS[qos])
        self.matched = self._publisher.matched

    def stamp_ns(self, frame: Frame) -> int:
        return frame.stamp_ns + self._offset_ns

    def publish(self, frame: Frame, trace: Trace) -> None:
        _, message = picture_message(frame, self._payload, self._offset_ns, trace)
        packed = self._publisher.pack(message)
        trace.mark("cdr_pack")
        self._publisher.send(packed)


@dataclass(frozen=True, slots=True)
class CachedFrame:
    """The newest camera frame, ready for the engine, and its way through this process."""

    frame: Frame
    marks: list[Mark]
    count: int
    """The number of frames up to this one."""

    @property
    def received_ns(self) -> int:
        """Return when it came, on CLOCK_MONOTONIC."""
        return self.marks[0][1]


class CameraCache:
    """Keeps the newest frame of both camera topics, already as RGB, each topic on a thread of its own."""

    def __init__(self, middleware: Middleware, namespace: str, options: RosOptions, limits: Limits = LIMITS) -> None:
        self.limits = limits
        self._middleware, self._options = middleware, options
        topics = ((CAMERA, ros.IMAGE), (COMPRESSED_CAMERA, ros.COMPRESSED_IMAGE))
        self._cameras = [
            middleware.subscription(namespace + topic, kind, CAMERA_QOS[options.qos]) for topic, kind in topics
        ]
        self._subscriptions = [*self._cameras]
        self._threads = [Thread(target=self._watch, args=(camera,), daemon=True) for camera in self._cameras]
        self._sim_ns: int | None = None
        if options.use_sim_time:
            clock = middleware.subscription(CLOCK, ros.CLOCK, CLOCK_QOS)
            self._subscriptions.append(clock)
            self._threads.append(Thread(target=self._follow, args=(clock,), daemon=True))
        self._newest: CachedFrame | None = None
        self._count = 0
        self._unused = ""
        """Why the last frame cannot be used."""
        self._silent = False
        """Whether a request has waited for the first frame in vain."""
        self._once = LogOnce(_log)
        self._lock = Lock()
        self._stopped = False

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def interrupt(self) -> None:
        self._stopped = True
        for subscription in self._subscriptions:
            subscription.interrupt()

    def join(self) -> None:
        for thread in self._threads:
            thread.join()

    def newest(self, trace: Trace) -> tuple[Frame, ...]:
        """Return the newest frame for a request that carries none; note in its trace which frame it is, and its age.

        It is () where no frame has come and the topics have no publisher. Raises RequestFailed where they have one,
        after `FIRST_FRAME_S` at most, and for a frame that came more than ``max_frame_age`` ago.
        """
        newest = self._newest or self._first(trace)
        if newest is None:
            return ()
        trace.frame_stamp_ns, trace.frame_marks = newest.frame.stamp_ns, newest.marks
        trace.facts[CAMERA_FRAMES] = newest.count
        at_ns = now_ns()
        age_s = (at_ns - newest.received_ns) / 1e9
        trace.facts[CAMERA_AGE_MS] = age_s * 1e3
        if newest.frame.stamp_ns:  # some cameras leave it out
            self._note_stamp_age(trace, newest.frame.stamp_ns, at_ns)
        if age_s > self._options.max_frame_age:
            trace.facts[STALE_FRAMES] = 1.0
            raise RequestFailed(
                f"the camera's newest frame came {age_s:.1f} s ago, more than `max_frame_age` "
                f"{self._options.max_frame_age:g} s: {self.silence() or 'see whether the camera still publishes'}"
            )
        return (newest.frame,)

    def _note_stamp_age(self, trace: Trace, stamp_ns: int, at_ns: int) -> None:
        """Note the age by the stamp, on the clock that stamps it: the wall's, or that of `CLOCK`."""
        if not self._options.use_sim_time:
            trace.facts[CAMERA_STAMP_AGE_MS] = (at_ns + realtime_offset_ns() - stamp_ns) / 1e6
        elif self._sim_ns is not None:
            trace.facts[CAMERA_SIM_AGE_MS] = (self._sim_ns - stamp_ns) / 1e6
        else:
            self._once.warning(CLOCK, "no time on %s: frames have no age by their stamps", CLOCK)

    def _first(self, trace: Trace) -> CachedFrame | None:
        """Wait for the first frame; None where the topics have no publisher, which the log has once.

        Raises RequestFailed where they have one: at once, after a request that has waited in vain.
        """
        if not self._silent:
            wait_s = min(self._options.max_frame_age, FIRST_FRAME_S)
            self._silent = not appeared(
                lambda: bool(self._newest) or not self._publishers(), wait_s, lambda: self._stopped
            )
            trace.mark(RESIDUAL)
        if self._newest is None and (silence := self.silence()):
            raise RequestFailed(f"no picture: {silence}")
        self._silent = False
        if self._newest is None:
            topics = " or ".join(camera.topic for camera in self._cameras)
            self._once.warning(
                "", "no camera: no publisher on %s; requests without a picture are answered from text", topics
            )
        return self._newest

    def silence(self) -> str:
        """Return the places to look at if no frame comes although the topics have publishers; "" if they have none."""
        counts = self._publishers().items()
        present = ", ".join(f"{count} publisher{'s' if count > 1 else ''} on {topic}" for topic, count in counts)
        if not present:
            return ""
        if self._unused:
            return f"{present}, none of its frames can be used: {self._unused}"
        buffers = ROS.against_loss(self._options).replace("--", "")
        silence = f"{present}, no frame comes: look at the buffers ({buffers}) and at what is published"
        strict = self._options.qos == "reliable"
        return f"{silence}; a best-effort publisher is received with qos sensor_data" if strict else silence

    def _publishers(self) -> dict[str, int]:
        """Count the topics' publishers: among all of the domain, which takes a while, only where none is matched."""
        counts = Counter({camera.topic: camera.matched() for camera in self._cameras})
        if not any(counts.values()):
            counts = Counter(offer.topic for offer in self._middleware.offers())
        return {camera.topic: counts[camera.topic] for camera in self._cameras if counts[camera.topic]}

    def seen(self) -> tuple[int, int | None]:
        """Return how many frames have come, and when the newest usable one did (CLOCK_MONOTONIC)."""
        newest = self._newest
        return self._count, newest.received_ns if newest else None

    def _watch(self, camera: Subscription) -> None:
        while not self._stopped:
            try:
                packed = camera.take(POLL_S)
                if packed is not None:
                    self._keep(camera, packed)
                    self._unused = ""
            except Exception as error:  # noqa: BLE001 - the camera survives an unusable frame
                self._unused = str(error) or type(error).__name__
                self._once.warning(self._unused, "camera frame not used: %s", self._unused)

    def _follow(self, clock: Subscription) -> None:
        while not self._stopped:
            with suppress(TransportError):  # of a message that cannot be read; the next may be
                if (packed := clock.take(POLL_S)) is not None:
                    self._sim_ns = ros.nanoseconds(clock.unpack(packed).clock)

    def _keep(self, camera: Subscription, packed: Any) -> None:
        """Decode a frame and keep it, unless one that came later is there already."""
        trace = Trace()
        trace.mark("network")
        with self._lock:
            self._count += 1
            count = self._count
        message = camera.unpack(packed)
        trace.mark("cdr_parse")
        frame = picture_of(message, trace, self.limits.pixels)
        with self._lock:
            if self._newest is None or count > self._newest.count:
                self._newest = CachedFrame(frame, trace.marks, count)
