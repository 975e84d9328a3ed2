"""The ROS variant `action`: ``llama_msgs/action/GenerateResponse``, as llama_ros speaks it, tokens as feedback.

Our own server also publishes its marks on ``<namespace>/marks``, keyed by the goal's id; a plain llama_ros node does
not, and then everything between packing and the first token is the stage `server`. A goal has no token limit, so the
client cancels it after the last token that it wants; our own server has a limit of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from typing import Any

from s2a_bench.clock import now_ns, realtime_offset_ns
from s2a_bench.errors import MessagesLost, RequestFailed, S2AError, ServerDied, TransportError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.ros import (
    ActionClient,
    Feedback,
    Middleware,
    QoS,
    Rejected,
    Result,
    ServerGoal,
)
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal, goal_images, text_result, token_feedback
from s2a_bench.trace import Trace
from s2a_bench.transport import CameraSink, Wiring
from s2a_bench.transport.bounds import Bounds
from s2a_bench.transport.ros.camera import POLL_S, CameraPublisher, picture_message, picture_of
from s2a_bench.transport.ros.joining import domain_of, join, namespace_of, wait_until
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.sampling import Wishes
from s2a_bench.transport.ros.wire import (
    PROVENANCE_TOPIC,
    READER_QOS,
    TOKEN_QOS,
    marks_message,
    readable,
    remote_of,
    token_message,
    told_by,
)
from s2a_bench.types import Request, Token

ACTION = "/generate_response"
MARKS = "/marks"
MEDIA_MARKER = "<__media__>"
"""Where a picture goes in a llama_ros prompt."""
MARKS_TIMEOUT_S = 2.0
NO_SEED = 2**32 - 1
"""SamplingConfig.seed of a client that does not care."""
_log = logging.getLogger(__name__)


class GenerateClient:
    """Sends goals and collects the feedback, from our own server or a llama_ros node."""

    def __init__(self, wiring: Wiring[RosOptions], alive: Callable[[], bool]) -> None:
        """Join the domain and wait for the action; raises ServerDied if it does not appear."""
        self._wiring = wiring
        self._alive = alive
        self._offset_ns = realtime_offset_ns()
        self.middleware = join(wiring, "client")
        namespace = namespace_of(wiring)
        self._name = wiring.options.action or namespace + ACTION
        self.camera: CameraSink | None = None
        try:
            self._client, self._version = self._connect()
            self._marks = None
            self._origin = self.middleware.subscription(
                self._name.rpartition("/")[0] + PROVENANCE_TOPIC, ros.PROVENANCE, QoS(depth=1, latched=True)
            )
            if not wiring.black_box:
                self._marks = self.middleware.subscription(namespace + MARKS, ros.MARKS, READER_QOS)
                camera = CameraPublisher(self.middleware, namespace, wiring.options.payload, wiring.options.qos)
                self.camera = camera
                self._wait(lambda: bool(camera.matched()))
                self._wait(lambda: bool(self._marks and self._marks.matched()))
        except TransportError:
            self.close()
            raise

    def _connect(self) -> tuple[ActionClient, str]:
        """Find the server and speak the version of llama_msgs that its type hash shows, ours where it shows none."""
        version = ros.DEFAULT_VERSION
        client = self.middleware.action_client(self._name, GENERATE_RESPONSE, version)
        self._find(client)
        spoken = client.server_version() or version
        if spoken != version:
            self.middleware.close()  # a client of the other version would go on collecting what nobody reads
            self.middleware = join(self._wiring, "client")
            client = self.middleware.action_client(self._name, GENERATE_RESPONSE, spoken)
            self._find(client)
        return client, spoken

    def _find(self, client: ActionClient) -> None:
        """Wait for the server; raises TransportError for one that is there and cannot be spoken to."""
        try:
            self._wait(client.server_present)
        except ServerDied as absent:
            if other := client.other_dds():
                raise TransportError(
                    f"the action server {self._name} is on {other}, whose services have another form on the wire: "
                    "start it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or use `middleware` rclpy with its RMW"
                ) from absent
            raise

    def _wait(self, arrived: Callable[[], bool]) -> None:
        absent = f"no action server appeared at {self._name} in DDS domain {domain_of(self._wiring)}"
        wait_until(arrived, self._alive, absent)

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Send a goal and yield its tokens."""
        payload = self._wiring.options.payload
        images = [picture_message(frame, payload, self._offset_ns, trace)[1] for frame in request.images]
        sampling: dict[str, Any] = {"grammar": request.grammar}
        if self._version != "4.4":
            sampling["seed"] = request.seed
        prompt = MEDIA_MARKER * len(images) + request.prompt
        packed = self._client.pack(generate_goal(prompt, images, version=self._version, **sampling))
        trace.mark("cdr_pack")
        goal_id = self._client.send(packed)
        trace.facts[PAYLOAD_BYTES] = len(packed)
        yield from self._tokens(goal_id, request.max_tokens, trace)

    def _tokens(self, goal_id: bytes, limit: int, trace: Trace) -> Iterator[Token]:
        """Yield the tokens of a goal; it is cancelled after ``limit``, or when the caller leaves early."""
        bounds = Bounds(self._name, self._wiring.deadline_of(limit), limit)
        count = 0
        heard: list[str] = []
        ended = False
        try:
            while not ended:
                event = self._next(goal_id, bounds)
                if isinstance(event, Feedback):
                    partial = self._client.unpack_feedback(event.packed).partial_response
                    bounds.piece()
                    bounds.came(len(partial.text))
                    heard.append(partial.text)
                    if count == limit:
                        continue
                    if not count:
                        trace.mark("server" if self._marks is None else "return")
                    yield Token(count, partial.text, partial.token)
                    count += 1
                    if count == limit and self._marks is None:
                        self._client.cancel(goal_id)  # our own server knows the limit
                elif isinstance(event, Rejected):
                    ended = True
                    raise RequestFailed("the server rejected the goal")
                elif isinstance(event, Result):
                    ended = True
                    told = self._learn(goal_id.hex(), trace)  # of a goal that failed, too
                    self._check(event, "".join(heard))
                    if not told:
                        raise RequestFailed("the server's marks did not arrive")
        finally:
            if not ended:
                self._client.cancel(goal_id)

    def _check(self, result: Result, heard: str) -> None:
        """Raise for a goal that failed, and for feedback that was lost on the way from our own server."""
        response = self._client.unpack_result(result.packed).response
        if result.status not in {Status.SUCCEEDED, Status.CANCELED}:
            text = response.text or f"the goal ended with status {result.status}"
            raise RequestFailed(f"the server broke off: {text}")
        if self._marks is not None and result.status == Status.SUCCEEDED and heard != response.text:
            raise MessagesLost(f"of the answer's {len(response.text)} letters {len(heard)} came as feedback")

    def _next(self, goal_id: bytes, bounds: Bounds) -> Any:
        """Wait for the next event of this goal."""
        deadline = now_ns() + int(self._wiring.timeout_s * 1e9)
        while now_ns() < deadline:
            event = self._client.next_event(min(POLL_S, bounds.left_s()))
            if event is not None and event.goal_id == goal_id:
                return event
            if event is None and not (self._alive() and self._client.server_present()):
                raise ServerDied(f"the action server {self._name} is gone")
        raise RequestFailed(f"no feedback for {self._wiring.timeout_s:.0f} s")

    def _learn(self, goal_id: str, trace: Trace) -> bool:
        """Take our server's marks of a goal, which were sent before its result; of another, who it is."""
        if self._marks is None:
            if (told := self._origin.take(0)) and (origin := readable(self._origin, told, trace)) is not None:
                trace.provenance = told_by(origin)
            return True
        deadline = now_ns() + int(MARKS_TIMEOUT_S * 1e9)
        while now_ns() < deadline:
            packed = self._marks.take(POLL_S)
            if packed is not None:
                marks = readable(self._marks, packed, trace)
                if marks is not None and marks.id == goal_id:
                    trace.receive(remote_of(marks))
                    return True
        return False

    def describe(self) -> dict[str, str]:
        """Add nothing: the wiring tells all."""
        return {}

    def close(self) -> None:
        """Leave the domain."""
        self.middleware.close()


class ActionFront:
    """The server's side of the variant."""

    def __init__(self, middleware: Middleware, wiring: Wiring[RosOptions], honoured: Collection[str] = ()) -> None:
        """Offer the action and create the topics; ``honoured`` are the engine's names in `Request.sampling`."""
        namespace, options = namespace_of(wiring), wiring.options
        self.limits = wiring.limits
        self._wiring = wiring
        self.tune(options)
        self._server = middleware.action_server(
            namespace + ACTION, GENERATE_RESPONSE, options.result_timeout, options.llama_msgs
        )
        self.version = self._server.version
        self.wishes = Wishes(honoured, self.version)
        self._marks = middleware.publisher(namespace + MARKS, ros.MARKS, TOKEN_QOS)
        self._plot = middleware.publisher(namespace + "/token", ros.TOKEN, QoS()) if options.publish_tokens else None

    def tune(self, options: RosOptions) -> None:
        """Follow the options that may change while it runs."""
        self.max_tokens = min(options.max_tokens or self._wiring.max_tokens, self._wiring.limits.answer_tokens)
        self.feedback_interval_ns = int(options.feedback_interval * 1e9)

    def take(self, timeout_s: float) -> ServerGoal | None:
        """Wait for the next goal."""
        return self._server.next_goal(timeout_s)

    def job(self, packed: ServerGoal, trace: Trace) -> GenerateJob | None:
        """Unpack a goal; one that cannot be read, or is of another version, is rejected."""
        if other := packed.other_version():
            self.refuse(packed, f"its client speaks llama_msgs {other}, this server {self.version} (--llama-msgs)")
            return None
        try:
            goal = packed.unpack()
        except S2AError as error:
            self.refuse(packed, str(error))
            return None
        trace.mark("cdr_parse")
        return GenerateJob(self, packed, goal, trace)

    def size_bytes(self, packed: ServerGoal) -> int:
        """Return the size of a goal."""
        return packed.size_bytes

    def refuse(self, packed: ServerGoal, why: str) -> None:
        """Reject a goal; the reason goes to the log, as a rejection has no words."""
        _log.warning("goal %s rejected: %s", packed.id.hex(), why)
        packed.reject()

    def plot(self, goal_id: str, token: Token) -> None:
        """Publish a token for whoever plots, where that is wanted."""
        if self._plot is not None:
            self._plot.send(self._plot.pack(token_message(goal_id, token, last=False)))

    def ended(self, goal_id: str, trace: Trace) -> None:
        """Send a goal's marks, before its result."""
        self._marks.send(self._marks.pack(marks_message(goal_id, trace.to_remote())))

    def interrupt(self) -> None:
        """Make `take` return; callable from any thread."""
        self._server.interrupt()


class GenerateJob:
    """One goal: ACCEPTED while it waits, EXECUTING when its turn comes."""

    def __init__(self, front: ActionFront, goal: ServerGoal, message: Any, trace: Trace) -> None:
        """Remember the goal."""
        self.trace = trace
        self._front = front
        self._goal = goal
        self._message = message
        self._id = goal.id.hex()
        self._stop = [text for text in message.stop if text]
        self._tokens: list[Token] = []
        self._held: list[str] = []
        self._fed_ns = 0
        self._error = ""
        self._started = False

    def accept(self) -> None:
        """Accept the goal; from here on only `end` ends it."""
        self._goal.accept()
        self.trace.mark("accept")

    def prepare(self) -> Request | None:
        """Decode the pictures."""
        message, limits = self._message, self._front.limits
        try:
            images = tuple(picture_of(image, self.trace, limits) for image in goal_images(message))
            wishes = self._front.wishes.of(message.sampling_config)
        except Exception as error:  # noqa: BLE001 - the goal is accepted, so it has to end, whatever broke
            self._error = str(error) or type(error).__name__
            return None
        sampling = message.sampling_config
        seed = getattr(sampling, "seed", NO_SEED)
        return Request(
            id=self._id,
            prompt=message.prompt.replace(MEDIA_MARKER, ""),
            images=images,
            max_tokens=self._front.max_tokens,
            grammar=sampling.grammar,
            seed=0 if seed == NO_SEED else seed,
            sampling=wishes,
        )

    def start(self) -> bool:
        """Let the goal be EXECUTING, unless a cancel came first."""
        self._started = self._goal.executing()
        self.trace.mark("accept")
        return self._started

    def token(self, token: Token) -> bool:
        """Send a token as feedback; return False after a cancel or a stop word."""
        if self._goal.cancel_requested:
            return False
        self._held.append(token.text)
        self._tokens.append(token)
        self._front.plot(self._id, token)
        if now_ns() - self._fed_ns >= self._front.feedback_interval_ns:
            self._feed()
        return not (self._stop and self._stopped())

    def _feed(self) -> None:
        """Send what is held as one feedback: one token, or several that came faster than ROS clients' queues hold."""
        if self._held:
            self._goal.feedback(token_feedback("".join(self._held), self._tokens[-1].id, self._front.version))
            self._held.clear()
            self._fed_ns = now_ns()

    def unwanted(self) -> bool:
        """Whether the goal was cancelled."""
        return self._goal.cancel_requested

    def _stopped(self) -> bool:
        text = "".join(token.text for token in self._tokens)
        return any(stop in text for stop in self._stop)

    def end(self, error: str = "") -> None:
        """Send marks and result."""
        error = error or self._error
        try:
            if self._started and not self._goal.cancel_requested:
                self._feed()
            self._front.ended(self._id, self.trace)
        except S2AError as failure:
            error = error or str(failure)
        text = error or "".join(token.text for token in self._tokens)
        result = text_result(text, [token.id for token in self._tokens], self._front.version)
        started = self._started or self._goal.executing()
        if self._goal.cancel_requested:
            self._goal.canceled(result)
        elif error or not started:
            self._goal.abort(result)
        else:
            self._goal.succeed(result)
