"""The server's side of the ROS variant `action`: goals become jobs of the engine's, tokens feedback."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError
from s2a_bench.ros import Middleware, QoS, ServerGoal
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE, goal_images, text_result, token_feedback
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.ros.action import ACTION, MARKS, MEDIA_MARKER
from s2a_bench.transport.ros.camera import picture_of
from s2a_bench.transport.ros.joining import namespace_of
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.sampling import Wishes
from s2a_bench.transport.ros.wire import TOKEN_QOS, marks_message, token_message
from s2a_bench.types import Piece, Request

NO_SEED = 2**32 - 1
"""SamplingConfig.seed of a client that does not care."""
_log = logging.getLogger(__name__)


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

    def plot(self, goal_id: str, token: Piece) -> None:
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
        self._tokens: list[Piece] = []
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

    def token(self, token: Piece) -> bool:
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
