"""The client of the ROS variant `action`: ``llama_msgs/action/GenerateResponse`` as in llama_ros, tokens as feedback.

Our own server also publishes its marks on ``<namespace>/marks``, keyed by the goal's id; a plain llama_ros node does
not, and then everything between packing and the first token is the stage `server`. A goal has no token limit, so the
client cancels it after the last token that it wants; our own server has a limit of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import MessagesLost, RequestFailed, ServerDied, TransportError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.ros import ActionClient, ActionEvent, Feedback, QoS, Rejected, Result
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Status
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal
from s2a_bench.ros.service import READER_QOS
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.ros.camera import POLL_S, picture_message
from s2a_bench.transport.ros.joining import RosClient, join, namespace_of, place_of, wait_until
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.ros.wire import PROVENANCE_TOPIC, provenance_of, readable, remote_of
from s2a_bench.types import Request, Token

ACTION = "/generate_response"
MARKS = "/marks"
MEDIA_MARKER = "<__media__>"
"""Where a picture goes in a llama_ros prompt."""
MARKS_TIMEOUT_S = 2.0


class GenerateClient(RosClient):
    def __init__(self, wiring: Wiring[RosOptions], alive: Callable[[], bool]) -> None:
        """Join the domain and wait for the action; raises ServerDied if it does not appear."""
        super().__init__(wiring, alive)
        namespace = namespace_of(wiring)
        self._name = wiring.options.action or namespace + ACTION
        try:
            self._client, self._version = self._connect()
            self._marks = None
            self._origin = self.middleware.subscription(
                self._name.rpartition("/")[0] + PROVENANCE_TOPIC, ros.PROVENANCE, QoS(depth=1, latched=True)
            )
            if not wiring.options.action:
                self._marks = self.middleware.subscription(namespace + MARKS, ros.MARKS, READER_QOS)
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
            self.middleware.close()  # a client of the other version would go on collecting messages that are never read
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
                    "start it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or ask in a sourced ROS 2 of its RMW"
                ) from absent
            raise

    def _wait(self, arrived: Callable[[], bool]) -> None:
        absent = f"no action server appeared at {self._name} in {place_of(self._wiring)}"
        wait_until(arrived, self._alive, absent)

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
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
        bounds = self._wiring.bounds(self._name, limit)
        count = 0
        heard: list[str] = []
        ended = False
        try:
            while not ended:
                event = self._next(goal_id, bounds)
                if isinstance(event, Feedback):
                    partial = self._client.unpack_feedback(event.packed).partial_response
                    bounds.count_piece()
                    bounds.count_bytes(len(partial.text))
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
                    marked = self._learn(goal_id.hex(), trace)  # of a goal that failed, too
                    self._check(event, "".join(heard))
                    if not marked:
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
        events: Iterator[ActionEvent | None] = self.taken(self._client.next_event, bounds)
        for event in events:
            if event is not None and event.goal_id == goal_id:
                return event
            if event is None and not (self._alive() and self._client.server_present()):
                raise ServerDied(f"the action server {self._name} has ended")
        raise RequestFailed(f"no feedback for {self._wiring.timeout_s:.0f} s")

    def _learn(self, goal_id: str, trace: Trace) -> bool:
        """Take our server's marks of a goal, which were sent before its result; of another, who it is."""
        if self._marks is None:
            if (marked := self._origin.take(0)) and (origin := readable(self._origin, marked, trace)) is not None:
                trace.provenance = provenance_of(origin)
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
