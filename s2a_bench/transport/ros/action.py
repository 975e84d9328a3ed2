"""The ROS variant `action`: ``llama_msgs/action/GenerateResponse`` as in llama_ros, tokens as feedback.

Our own server also publishes its marks on ``<namespace>/marks``, keyed by the goal's id; a plain llama_ros node does
not, and then everything between packing and the first token is the stage `server`. A goal has no token limit, so the
client cancels it after the last token that it wants; our own server has a limit of its own. What a goal wants of
sampling are the fields of ``llama_msgs/SamplingConfig`` that differ from their defaults: a client that does not care
sends the defaults, and then the engine's own settings hold.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from typing import Any, Final

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import MessagesLost, RequestFailed, S2AError, ServerDied, TransportError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.ros import ActionClient, ActionEvent, Feedback, Middleware, QoS, Rejected, Result, ServerGoal, llama
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.service import READER_QOS
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.ros import wire
from s2a_bench.transport.ros.camera import POLL_S, picture_message, pictures_of
from s2a_bench.transport.ros.exchange import RosExchange, Shared
from s2a_bench.transport.ros.joining import RosClient, join, namespace_of
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.types import Piece, Request, Sampling, Token

ACTION = "/generate_response"
MARKS = "/marks"
MEDIA_MARKER = "<__media__>"
"""The place of a picture in a llama_ros prompt."""
MARKS_TIMEOUT_S = 2.0
NO_SEED = 2**32 - 1
"""SamplingConfig.seed of a client without a wish."""
BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "temp": (0, 100),
    "top_k": (-1, 2**31 - 1),
    "top_p": (0, 1),
    "min_p": (0, 1),
    "typical_p": (0, 1),
    "penalty_last_n": (-1, 2**20),
    "penalty_repeat": (0.01, 100),
    "penalty_freq": (-100, 100),
    "penalty_present": (-100, 100),
    "mirostat": (0, 2),
    "mirostat_eta": (0, 10),
    "mirostat_tau": (0.01, 100),
}
"""Field -> what makes sense of it: the numbers that an engine may honour."""
NOT_LOGGED: Final = frozenset({"seed", "grammar", "dry_sequence_breakers"})
"""Fields that a goal's request reads separately, and one that ROS encodes in two ways."""
_log = logging.getLogger(__name__)


class GenerateClient(RosClient):
    def _meet_server(self, namespace: str) -> None:
        action = self._wiring.options.action
        self._name = action or namespace + ACTION
        self._absent = f"no action server appeared at {self._name}"
        self._version = ros.DEFAULT_VERSION  # until a server's type hash shows another
        self._client = self._open_client()
        if (spoken := self._client.server_version() or self._version) != self._version:
            self.middleware.close()  # a client of the other version would go on collecting messages that are never read
            self.middleware, self._version = join(self._wiring, "client"), spoken
            self._client = self._open_client()
        self._marks = None
        self._origin = self.middleware.subscription(
            self._name.rpartition("/")[0] + wire.PROVENANCE_TOPIC, ros.PROVENANCE, QoS(depth=1, latched=True)
        )
        if not action:
            self._marks = self.middleware.subscription(namespace + MARKS, ros.MARKS, READER_QOS)
            self.wait_until(lambda: bool(self._marks and self._marks.matched()), self._absent)

    def _open_client(self) -> ActionClient:
        """Wait for the server; raises TransportError for one that is there and cannot be spoken to."""
        client = self.middleware.action_client(self._name, llama.GENERATE_RESPONSE, self._version)
        try:
            self.wait_until(client.server_present, self._absent)
        except ServerDied as absent:
            if other := client.other_dds():
                raise TransportError(
                    f"the action server {self._name} is on {other}, whose services have another form on the wire: "
                    "start it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or ask in a sourced ROS 2 of its RMW"
                ) from absent
            raise
        return client

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        payload = self._wiring.options.payload
        images = [picture_message(frame, payload, self._offset_ns, trace)[1] for frame in request.images]
        sampling: dict[str, Any] = {"grammar": request.grammar}
        if self._version != "4.4":  # whose SamplingConfig has no seed
            sampling["seed"] = request.seed
        prompt = MEDIA_MARKER * len(images) + request.prompt
        packed = self._client.pack(llama.generate_goal(prompt, images, version=self._version, **sampling))
        trace.mark("cdr_pack")
        goal_id = self._client.send(packed)
        trace.facts[PAYLOAD_BYTES] = len(packed)
        yield from self._tokens(goal_id, request.max_tokens, trace)

    def _tokens(self, goal_id: bytes, limit: int, trace: Trace) -> Iterator[Token]:
        """Yield the tokens of a goal; it is cancelled after ``limit``, or when the caller leaves early."""
        bounds = self._wiring.bounds(self._name, limit)
        count = 0
        heard: list[str] = []
        ended = False
        try:
            while not ended:
                event = self._next(goal_id, bounds)
                if isinstance(event, Feedback):
                    partial = self._client.unpack_feedback(event.packed).partial_response
                    bounds.count_bytes(len(partial.text))
                    heard.append(partial.text)
                    if count == limit:  # sent before the server saw the cancel
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
                    marked = self._learn(goal_id.hex(), trace)  # of a goal that failed, too
                    self._check(event, "".join(heard))
                    if not marked:
                        raise RequestFailed("the server's marks did not arrive")
        finally:
            if not ended:
                self._client.cancel(goal_id)

    def _check(self, result: Result, heard: str) -> None:
        response = self._client.unpack_result(result.packed).response
        if result.status not in {Status.SUCCEEDED, Status.CANCELED}:
            text = response.text or f"the goal ended with status {result.status}"
            raise RequestFailed(f"the server broke off: {text}")
        if self._marks is not None and result.status == Status.SUCCEEDED and heard != response.text:
            raise MessagesLost(f"of the answer's {len(response.text)} letters {len(heard)} came as feedback")

    def _next(self, goal_id: bytes, bounds: Bounds) -> Any:
        events: Iterator[ActionEvent | None] = self.taken(self._client.next_event, bounds)
        for event in events:
            if event is not None and event.goal_id == goal_id:
                return event
            if event is None and not (self._alive() and self._client.server_present()):
                raise ServerDied(f"the action server {self._name} has ended")
        raise RequestFailed(f"no feedback for {self._wiring.timeout_s:.0f} s")

    def _learn(self, goal_id: str, trace: Trace) -> bool:
        """Take our server's marks of a goal, which were sent before its result; of another server, its provenance."""
        if self._marks is None:
            if (marked := self._origin.take(0)) and (origin := wire.readable(self._origin, marked, trace)) is not None:
                trace.provenance = wire.provenance_of(origin)
            return True
        deadline = now_ns() + int(MARKS_TIMEOUT_S * 1e9)
        while now_ns() < deadline:
            packed = self._marks.take(POLL_S)
            if packed is not None:
                marks = wire.readable(self._marks, packed, trace)
                if marks is not None and marks.id == goal_id:
                    trace.receive(wire.remote_of(marks))
                    return True
        return False


class ActionSource:
    def __init__(self, middleware: Middleware, wiring: Wiring[RosOptions], honoured: Collection[str] = ()) -> None:
        """Offer the action and create the topics; ``honoured`` are the engine's names in `Request.sampling`."""
        namespace, options = namespace_of(wiring), wiring.options
        self.limits = wiring.limits
        self._wiring = wiring
        self.tune(options)
        self._server = middleware.action_server(
            namespace + ACTION, llama.GENERATE_RESPONSE, options.result_timeout, options.llama_msgs
        )
        self.take, self.interrupt, self.version = self._server.next_goal, self._server.interrupt, self._server.version
        self.wishes = Wishes(honoured, self.version)
        self._marks = middleware.publisher(namespace + MARKS, ros.MARKS, wire.TOKEN_QOS)
        self._plot = middleware.publisher(namespace + "/token", ros.TOKEN, QoS()) if options.publish_tokens else None

    def tune(self, options: RosOptions) -> None:
        self.max_tokens = min(options.max_tokens or self._wiring.max_tokens, self._wiring.limits.answer_tokens)
        self.feedback_interval_ns = int(options.feedback_interval * 1e9)

    def exchange(self, packed: ServerGoal, shared: Shared, trace: Trace) -> GoalExchange:
        """Unpack a goal; raises TransportError for one that cannot be read, or is of another version."""
        if other := packed.other_version():
            raise RequestFailed(f"its client speaks llama_msgs {other}, this server {self.version} (--llama-msgs)")
        goal = packed.unpack()
        trace.mark("cdr_parse")
        return GoalExchange(self, packed, goal, shared, trace)

    def size_bytes(self, packed: ServerGoal) -> int:
        return packed.size_bytes

    def refuse(self, packed: ServerGoal, why: str) -> None:
        """Reject a goal; the reason goes to the log, as a rejection has no words."""
        _log.warning("goal %s rejected: %s", packed.id.hex(), why)
        packed.reject()

    def plot(self, goal_id: str, token: Piece) -> None:
        if self._plot is not None:
            self._plot.send(self._plot.pack(wire.token_message(goal_id, token, last=False)))

    def ended(self, goal_id: str, trace: Trace) -> None:
        """Send a goal's marks, before its result."""
        self._marks.send(self._marks.pack(wire.marks_message(goal_id, trace.to_remote())))


class GoalExchange(RosExchange):
    """One goal: ACCEPTED while it waits, EXECUTING when its turn comes."""

    def __init__(self, source: ActionSource, goal: ServerGoal, message: Any, shared: Shared, trace: Trace) -> None:
        super().__init__(shared, trace)
        self._source, self._goal, self._message = source, goal, message
        self._id = goal.id.hex()
        self._stop = [text for text in message.stop if text]
        self._tokens: list[Piece] = []
        self._held: list[str] = []
        self._fed_ns = 0
        self._started = False

    def accept(self) -> None:
        """Accept the goal; from here on only `finish` ends it."""
        self._goal.accept()
        self.trace.mark("accept")

    def request(self) -> Request:
        message, sampling = self._message, self._message.sampling_config
        seed = getattr(sampling, "seed", NO_SEED)
        return Request(
            id=self._id,
            prompt=message.prompt.replace(MEDIA_MARKER, ""),
            images=pictures_of(llama.goal_images(message), self.trace, self._source.limits),
            max_tokens=self._source.max_tokens,
            grammar=sampling.grammar,
            seed=0 if seed == NO_SEED else seed,
            sampling=self._source.wishes.of(sampling),
        )

    def cancelled(self) -> bool:
        return self._goal.cancel_requested

    def started(self) -> bool:
        self._started = self._goal.executing()
        self.trace.mark("accept")
        return self._started

    def piece(self, piece: Piece) -> bool:
        """Send a token as feedback; return False after a cancel or a stop word."""
        if self._goal.cancel_requested:
            return False
        self._held.append(piece.text)
        self._tokens.append(piece)
        self._source.plot(self._id, piece)
        if now_ns() - self._fed_ns >= self._source.feedback_interval_ns:
            self._feed()
        text = self._text() if self._stop else ""
        return not any(stop in text for stop in self._stop)

    def _feed(self) -> None:
        """Send the held tokens as one feedback: one, or several that came faster than ROS clients' queues hold."""
        if self._held:
            self._goal.feedback(llama.token_feedback("".join(self._held), self._tokens[-1].id, self._source.version))
            self._held.clear()
            self._fed_ns = now_ns()

    def _text(self) -> str:
        return "".join(token.text for token in self._tokens)

    def finish(self, error: str) -> None:
        try:
            if self._started and not self._goal.cancel_requested:
                self._feed()
            self._source.ended(self._id, self.trace)
        except S2AError as failure:
            error = error or str(failure)
        result = llama.text_result(error or self._text(), [token.id for token in self._tokens], self._source.version)
        started = self._started or self._goal.executing()
        if self._goal.cancel_requested:
            self._goal.canceled(result)
        elif error or not started:
            self._goal.abort(result)
        else:
            self._goal.succeed(result)


class Wishes:
    def __init__(self, honoured: Collection[str], version: str) -> None:
        self._honoured = honoured
        self._defaults = llama.sampling_config(version)
        self._logged: set[str] = set()

    def of(self, config: Any) -> Sampling:
        """Return the wishes that the engine honours; raises RequestFailed for a number that makes no sense."""
        defaults = vars(self._defaults).items()
        wanted = [name for name, default in defaults if _differs(getattr(config, name, default), default)]
        left_out = [name for name in wanted if name not in self._honoured and name not in self._logged | NOT_LOGGED]
        if left_out:
            self._logged.update(left_out)
            _log.warning("not honoured of goals' sampling_config: %s", ", ".join(left_out))
        return tuple((name, _checked(name, getattr(config, name))) for name in wanted if name in self._honoured)


def _differs(value: Any, default: Any) -> bool:
    if isinstance(default, float):
        return bool(np.float32(value) != np.float32(default))
    return not np.array_equal(value, default) if isinstance(default, np.ndarray) else bool(value != default)


def _checked(name: str, value: float) -> float:
    least, most = BOUNDS[name]
    if not least <= value <= most:
        raise RequestFailed(f"sampling_config.{name}: {value:g} is not {least:g} to {most:g}")
    return value
