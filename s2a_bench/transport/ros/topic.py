"""The ROS variant `topic`: a request message goes to ``<namespace>/request``, tokens return on ``<namespace>/token``.

The camera is a plain ``sensor_msgs/Image`` (or CompressedImage) topic, so any ROS 2 subscriber sees it; in stream
mode the server keeps its newest frame, converted already, for requests that carry none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from threading import Lock, Thread
from typing import Any

from s2a_bench.clock import now_ns, realtime_offset_ns
from s2a_bench.errors import MessagesLost, RequestFailed, S2AError, ServerDied, TransportError
from s2a_bench.ros import Middleware, QoS, Tuning, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Mark, Remote, Trace
from s2a_bench.transport import Handler, Route
from s2a_bench.transport.pictures import bgr_of, decoded, encoded, rgb_of
from s2a_bench.types import Frame, Request, Token

WIRES = ("bgr", "yuyv", "compressed")
DEFAULT_NAMESPACE = "/s2a_bench"
CAMERA = "/camera/image_raw"
COMPRESSED_CAMERA = "/camera/image_raw/compressed"
FRAME_ID = "camera"

REQUEST_QOS = QoS(depth=10)
READER_QOS = QoS(depth=0)
"""Our readers keep all: history is local, and a burst of tokens overruns ROS's default of 10."""
TOKEN_QOS = QoS(depth=1000)
CAMERA_QOS = QoS(depth=1)

POLL_S = 0.5
MATCH_TIMEOUT_S = 15.0
SETTLE_S = 0.3
"""Time to discover a server that is there already."""


def _join(route: Route) -> Middleware:
    tuning: Tuning = "default" if route.dds_tuning == "default" else "tuned"
    return open_middleware(domain_id=route.domain_id, tuning=tuning)


def picture_message(frame: Frame, wire: str, offset_ns: int, trace: Trace) -> tuple[str, Any]:
    """Return (ROS type, message) of a frame for a wire format; ``offset_ns`` turns its stamp into ROS time."""
    stamp_ns = frame.stamp_ns + offset_ns
    if wire == "compressed":
        _, data = encoded(frame, "jpeg", trace)
        return ros.COMPRESSED_IMAGE, ros.compressed_image_message(data, stamp_ns, FRAME_ID)
    if wire == "yuyv" and frame.encoding != "yuv422_yuy2":
        raise RequestFailed(f"--wire yuyv: this source delivers {frame.encoding}; use --wire bgr")
    return ros.IMAGE, ros.image_message(bgr_of(frame, trace) if wire == "bgr" else frame, stamp_ns, FRAME_ID)


def _refuse_company(route: Route, namespace: str) -> None:
    """Raise TransportError if another server listens under ``namespace``: both would answer every request."""
    probe = _join(route)
    try:
        publisher = probe.publisher(namespace + "/request", ros.REQUEST, REQUEST_QOS)
        probe.subscription(namespace + "/token", ros.TOKEN, READER_QOS).take(SETTLE_S)
        if publisher.matched():
            raise TransportError(
                f"another server answers under {namespace} in DDS domain {route.domain_id}: stop it, "
                "or choose another domain with ROS_DOMAIN_ID or another --namespace"
            )
    finally:
        probe.close()


class CameraPublisher:
    """Publishes frames as a ROS 2 camera does."""

    def __init__(self, middleware: Middleware, namespace: str, wire: str) -> None:
        """Create the one topic that ``wire`` needs."""
        self._wire = wire
        self._offset_ns = realtime_offset_ns()
        if wire == "compressed":
            topic, type_name = namespace + COMPRESSED_CAMERA, ros.COMPRESSED_IMAGE
        else:
            topic, type_name = namespace + CAMERA, ros.IMAGE
        self._publisher = middleware.publisher(topic, type_name, CAMERA_QOS)

    def publish(self, frame: Frame, trace: Trace) -> int:
        """Convert, pack and send one frame; return its ROS-time stamp, by which the server names it."""
        _, message = picture_message(frame, self._wire, self._offset_ns, trace)
        packed = self._publisher.pack(message)
        trace.mark("cdr_pack")
        self._publisher.send(packed)
        return frame.stamp_ns + self._offset_ns

    def matched(self) -> int:
        """Count the subscriptions."""
        return self._publisher.matched()


class TopicClient:
    """Publishes requests and collects the tokens that carry their id."""

    def __init__(self, route: Route, alive: Callable[[], bool]) -> None:
        """Join the domain and wait for the server; raises ServerDied if it does not appear."""
        self._route = route
        self._alive = alive
        self._offset_ns = realtime_offset_ns()
        self.middleware = _join(route)
        namespace = route.address or DEFAULT_NAMESPACE
        self._publisher = self.middleware.publisher(namespace + "/request", ros.REQUEST, REQUEST_QOS)
        self._subscription = self.middleware.subscription(namespace + "/token", ros.TOKEN, READER_QOS)
        self.camera = CameraPublisher(self.middleware, namespace, route.wire)
        try:
            self._wait_until_matched(namespace)
        except TransportError:
            self.close()
            raise

    def _wait_until_matched(self, namespace: str) -> None:
        """Wait until requests reach the server and its tokens reach us: volatile messages are else lost."""
        deadline = now_ns() + int(MATCH_TIMEOUT_S * 1e9)
        ends = (self._publisher, self._subscription, self.camera)
        while not all(end.matched() for end in ends):
            if now_ns() > deadline or not self._alive():
                raise ServerDied(f"no server appeared under {namespace} in DDS domain {self._route.domain_id}")
            self._subscription.take(0.02)

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Publish the request, with its frames if it has any, and yield its tokens."""
        images: dict[str, list[Any]] = {ros.IMAGE: [], ros.COMPRESSED_IMAGE: []}
        for frame in request.images:
            type_name, message = picture_message(frame, self._route.wire, self._offset_ns, trace)
            images[type_name].append(message)
        packed = self._publisher.pack(
            ros.message(
                ros.REQUEST,
                id=request.id,
                prompt=request.prompt,
                grammar=request.grammar,
                max_tokens=request.max_tokens,
                seed=request.seed,
                images=images[ros.IMAGE],
                compressed_images=images[ros.COMPRESSED_IMAGE],
            )
        )
        trace.mark("cdr_pack")
        self._publisher.send(packed)
        trace.facts["payload_bytes"] = len(packed)
        expected = 0
        while True:
            token = self._next(request.id)
            if token.index != expected:
                raise MessagesLost(
                    f"token {token.index} came instead of {expected}: messages were lost, or two servers answer"
                )
            if token.last:
                break
            if not expected:
                trace.mark("return")
            yield Token(token.index, token.text, token.token)
            expected += 1
        if token.marks:
            trace.receive(_remote_of(token.marks[0]))
        if token.error:
            raise RequestFailed(f"the server broke off: {token.error}")

    def _next(self, request_id: str) -> Any:
        """Wait for the next token of this request, dropping what belongs to others."""
        deadline = now_ns() + int(self._route.timeout_s * 1e9)
        while now_ns() < deadline:
            packed = self._subscription.take(POLL_S)
            if packed is not None:
                token = self._subscription.unpack(packed)
                if token.id == request_id:
                    return token
            elif not self._alive():
                raise ServerDied("the server's process is gone")
        raise RequestFailed(f"no token for {self._route.timeout_s:.0f} s")

    def close(self) -> None:
        """Leave the domain."""
        self.middleware.close()


@dataclass(frozen=True, slots=True)
class _CachedFrame:
    """The newest camera frame, ready for the engine, and its way through this process."""

    frame: Frame
    marks: list[Mark]


class TopicServer:
    """Answers requests one after the other on the thread that calls `serve`; the camera has a thread of its own."""

    def __init__(self, route: Route, handler: Handler) -> None:
        """Join the domain and create the topics."""
        self.address = route.address or DEFAULT_NAMESPACE
        self._handler = handler
        _refuse_company(route, self.address)
        self.middleware = _join(route)
        self._requests = self.middleware.subscription(self.address + "/request", ros.REQUEST, READER_QOS)
        self._tokens = self.middleware.publisher(self.address + "/token", ros.TOKEN, TOKEN_QOS)
        cameras = ((CAMERA, ros.IMAGE), (COMPRESSED_CAMERA, ros.COMPRESSED_IMAGE))
        self._cameras = [
            self.middleware.subscription(self.address + topic, type_name, CAMERA_QOS) for topic, type_name in cameras
        ]
        self._newest: _CachedFrame | None = None
        self._closing = Lock()
        self._stopped = False

    def serve(self) -> None:
        """Serve until stopped."""
        threads = [Thread(target=self._watch, args=(camera,), daemon=True) for camera in self._cameras]
        for thread in threads:
            thread.start()
        while not self._stopped:
            packed = self._requests.take(POLL_S)
            if packed is not None:
                trace = Trace()
                trace.mark("network")
                self._answer(packed, trace)
                del packed  # gives the received bytes back before the next wait
        for thread in threads:
            thread.join()
        self.middleware.close()

    def stop(self) -> None:
        """Wake all threads."""
        with self._closing:
            if not self._stopped:
                self._stopped = True
                for subscription in (self._requests, *self._cameras):
                    subscription.interrupt()

    def _watch(self, camera: Any) -> None:
        """Keep the newest frame of one camera topic, already as RGB."""
        while not self._stopped:
            packed = camera.take(POLL_S)
            if packed is None:
                continue
            trace = Trace()
            trace.mark("network")
            try:
                message = camera.unpack(packed)
                trace.mark("cdr_parse")
                self._newest = _CachedFrame(_picture(message, trace), trace.marks)
            except S2AError:  # a frame nobody can read is no reason to stop: the next may be better
                continue

    def _answer(self, packed: Any, trace: Trace) -> None:
        """Answer one request; what goes wrong goes back to who asked."""
        try:
            message = self._requests.unpack(packed)
        except S2AError:  # nobody to answer to
            return
        trace.mark("cdr_parse")
        index = 0
        error = ""
        tokens: Iterator[Token] = iter(())
        try:
            images = tuple(_picture(image, trace) for image in (*message.images, *message.compressed_images))
            if not images and self._newest is not None:
                newest = self._newest
                images = (newest.frame,)
                trace.frame_stamp_ns, trace.frame_marks = newest.frame.stamp_ns, newest.marks
            tokens = self._handler(
                Request(message.id, message.prompt, images, message.max_tokens, message.grammar, message.seed), trace
            )
            for token in tokens:
                self._send(message.id, token, [])
                index += 1
        except S2AError as failure:
            error = str(failure)
        self._send(message.id, Token(index, "", -1), [_marks_message(message.id, trace.to_remote())], error)

    def _send(self, request_id: str, token: Token, marks: list[Any], error: str = "") -> None:
        """Publish one token, or with marks the end of the answer."""
        self._tokens.send(
            self._tokens.pack(
                ros.message(
                    ros.TOKEN,
                    id=request_id,
                    index=token.index,
                    text=token.text,
                    token=token.id,
                    last=bool(marks),
                    error=error,
                    marks=marks,
                )
            )
        )


def _picture(message: Any, trace: Trace) -> Frame:
    """Turn a received image message into an RGB frame; its stamp is ROS time."""
    if hasattr(message, "format"):
        frame = decoded("image/jpeg", message.data, trace)
        return replace(frame, stamp_ns=ros.stamp_of(message.header))
    return rgb_of(ros.frame_of_image(message), trace)


def _marks_message(request_id: str, remote: Remote) -> Any:
    """Turn a server's marks into s2a_msgs/Marks."""
    return ros.message(
        ros.MARKS,
        id=request_id,
        clock=remote.clock,
        stages=[stage for stage, _ in remote.marks],
        stamps=ros.int64_array(stamp for _, stamp in remote.marks),
        token_stamps=ros.int64_array(remote.token_ns),
        frame_stamp=remote.frame_stamp_ns,
        frame_stages=[stage for stage, _ in remote.frame_marks],
        frame_stamps=ros.int64_array(stamp for _, stamp in remote.frame_marks),
        fact_names=list(remote.facts),
        fact_values=ros.float64_array(remote.facts.values()),
    )


def _remote_of(marks: Any) -> Remote:
    """Read a server's marks from s2a_msgs/Marks."""
    return Remote(
        clock=marks.clock,
        marks=list(zip(marks.stages, marks.stamps.tolist(), strict=True)),
        token_ns=marks.token_stamps.tolist(),
        frame_stamp_ns=int(marks.frame_stamp),
        frame_marks=list(zip(marks.frame_stages, marks.frame_stamps.tolist(), strict=True)),
        facts=dict(zip(marks.fact_names, marks.fact_values.tolist(), strict=True)),
    )
