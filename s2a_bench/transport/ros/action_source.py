"""The server's side of the ROS variant `action`: goals become jobs of the engine's, tokens feedback.

What a goal wants of sampling are the fields of ``llama_msgs/SamplingConfig`` that differ from their defaults: a client
that does not care sends the defaults, and then the engine's own settings hold.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any, Final

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, S2AError
from s2a_bench.ros import Middleware, QoS, ServerGoal
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE, goal_images, sampling_config, text_result, token_feedback
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.ros.action import ACTION, MARKS, MEDIA_MARKER
from s2a_bench.transport.ros.camera import picture_of
from s2a_bench.transport.ros.exchange import RosExchange, Shared
from s2a_bench.transport.ros.joining import namespace_of
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.wire import TOKEN_QOS, marks_message, token_message
from s2a_bench.types import Piece, Request, Sampling

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


class ActionSource:
    def __init__(self, middleware: Middleware, wiring: Wiring[RosOptions], honoured: Collection[str] = ()) -> None:
        """Offer the action and create the topics; ``honoured`` are the engine's names in `Request.sampling`."""
        namespace, options = namespace_of(wiring), wiring.options
        self.limits = wiring.limits
        self._wiring = wiring
        self.tune(options)
        self._server = middleware.action_server(
            namespace + ACTION, GENERATE_RESPONSE, options.result_timeout, options.llama_msgs
        )
        self.take, self.interrupt, self.version = self._server.next_goal, self._server.interrupt, self._server.version
        self.wishes = Wishes(honoured, self.version)
        self._marks = middleware.publisher(namespace + MARKS, ros.MARKS, TOKEN_QOS)
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
            self._plot.send(self._plot.pack(token_message(goal_id, token, last=False)))

    def ended(self, goal_id: str, trace: Trace) -> None:
        """Send a goal's marks, before its result."""
        self._marks.send(self._marks.pack(marks_message(goal_id, trace.to_remote())))


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
            images=tuple(picture_of(image, self.trace, self._source.limits) for image in goal_images(message)),
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
        """Send what is held as one feedback: one token, or several that came faster than ROS clients' queues hold."""
        if self._held:
            self._goal.feedback(token_feedback("".join(self._held), self._tokens[-1].id, self._source.version))
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
        result = text_result(error or self._text(), [token.id for token in self._tokens], self._source.version)
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
        self._defaults = sampling_config(version)
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
