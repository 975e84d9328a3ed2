"""The client of lerobot's policy server: fill the template, pickle, send, wait for the chunk, and mark each step.

As lerobot's own client it waits in `GetActions` while it sends, because the server sleeps until a thirtieth of a second
after that call began (`--inference_latency`). Each observation has `must_go`, or the server would drop those like the
last one. The server holds one policy, which its last client named, and one observation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Final
from urllib.parse import SplitResult

import grpc

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed, ServerDied, TransportError
from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS
from s2a_bench.machine.doctor import Finding
from s2a_bench.plugins.policy_servers.grpc import GET_ACTIONS_MS, PAYLOAD_DOWN_BYTES, GrpcOptions
from s2a_bench.plugins.policy_servers.grpc.pickles import chunk_in, observation_of, pickled
from s2a_bench.plugins.policy_servers.policy_client import PolicyClient
from s2a_bench.trace import Trace
from s2a_bench.transport import Wiring
from s2a_bench.transport.limits import MIB, Bounds
from s2a_bench.transport.risks import connect
from s2a_bench.types import Piece, Request
from s2a_bench.vectors import actions_of

SERVICE, LOAD = "/transport.AsyncInference/", "SendPolicyInstructions"
PIECE_BYTES: Final = 2 * MIB
BEGIN, MIDDLE, END = 1, 2, 3
"""lerobot's TransferState of a piece of an observation."""
MORE: Final = 0x80
"""Set in each byte of protobuf's varint but the last."""
NO_CHUNK: Final = (
    "answered without a chunk: its policy raised an error, which only its log has, or no observation reached it within "
    "its --obs_queue_timeout (2 s), as another client took it"
)
_LOADED: Final[dict[str, dict[str, Any]]] = {}
"""URL -> the policy that a client of this process, which is open, named last: cells of a run may name others."""


class GrpcClient(PolicyClient[GrpcOptions]):
    def __init__(self, wiring: Wiring[GrpcOptions], alive: Callable[[], bool]) -> None:
        super().__init__(wiring, alive)
        self._channel: grpc.Channel | None = None  # kept when a request fails: each call is a stream of its own
        self._connected = False
        self._timestep = 0

    def _answer(self, request: Request, bounds: Bounds, trace: Trace) -> Iterator[Piece]:
        observation, features = observation_of(self._observation(request, trace), self._template.name)
        try:
            channel = self._open(features, bounds, trace)
            stamp, body = self._pack(observation, trace)
            answer = self._exchanged(channel, body, bounds, trace)
        except grpc.RpcError as error:
            raise self._reason(error) from error
        trace.facts[PAYLOAD_DOWN_BYTES] = len(answer)
        if not answer:
            _LOADED.pop(self._url, None)  # a server that was started again has no policy
            raise RequestFailed(f"{self._url} {NO_CHUNK}")
        first_stamp, chunk = chunk_in(bytes_in(answer))
        if first_stamp != stamp:
            raise RequestFailed(f"{self._url} answered about the observation of another client; stop that client")
        actions = actions_of(chunk)
        trace.mark("pickle_parse")
        yield from actions

    def _open(self, features: dict[str, Any], bounds: Bounds, trace: Trace) -> grpc.Channel:
        """Return the channel to the server, which holds our policy; marks `connect` if it had to load it."""
        policy = self._wiring.options.model_dump(include={"policy_type", "actions_per_chunk", "device"})
        policy |= {"pretrained_name_or_path": self._wiring.options.pretrained, "rename_map": {}}
        policy["lerobot_features"] = features
        if self._channel is None:
            self._channel = grpc.insecure_channel(self._url.partition("://")[2], [("grpc.enable_http_proxy", 0)])
            if self._connected:
                trace.facts[RECONNECTS] = 1.0
        if _LOADED.get(self._url) != policy:
            _LOADED.pop(self._url, None)
            for method, message in (("Ready", b""), (LOAD, message_of(pickled("RemotePolicyConfig", policy)))):
                self._channel.unary_unary(SERVICE + method)(message, self._patience_s(bounds))
            _LOADED[self._url] = policy
            trace.mark("connect")
        self._connected = True
        return self._channel

    def _pack(self, observation: dict[str, Any], trace: Trace) -> tuple[float, list[bytes]]:
        """Return the time stamp (Unix time, as lerobot has it), which the chunk repeats, and the messages."""
        stamp, self._timestep = time.time(), self._timestep + 1
        fields = {"timestamp": stamp, "timestep": self._timestep, "observation": observation, "must_go": True}
        body = memoryview(pickled("TimedObservation", fields))
        starts = range(0, len(body), PIECE_BYTES)
        states = [BEGIN, *[MIDDLE] * (len(starts) - 2), END][-len(starts) :]  # a single piece is END alone
        pieces = [
            bytes((8, state)) + message_of(body[start : start + PIECE_BYTES], 2)
            for state, start in zip(states, starts, strict=True)
        ]
        trace.mark("pickle_pack")
        trace.facts[PAYLOAD_BYTES] = sum(map(len, pieces))
        return stamp, pieces

    def _exchanged(self, channel: grpc.Channel, pieces: list[bytes], bounds: Bounds, trace: Trace) -> bytes:
        patience_s, started_ns = self._patience_s(bounds), now_ns()
        answer = channel.unary_unary(SERVICE + "GetActions").future(b"", patience_s)
        try:
            channel.stream_unary(SERVICE + "SendObservations")(iter(pieces), patience_s)
            trace.mark("send")
            message: bytes = answer.result()
            trace.mark("server")
        finally:
            answer.cancel()
        trace.facts[GET_ACTIONS_MS] = (trace.marks[-1][1] - started_ns) / 1e6
        return message

    def _patience_s(self, bounds: Bounds) -> float:
        return min(self._wiring.timeout_s, bounds.left_s())

    def _reason(self, error: Any) -> TransportError:
        """Return the error that says what gRPC's status means; a connection that broke is made again."""
        code, why = error.code(), " ".join(str(error.details()).split())[:500]
        if code is grpc.StatusCode.UNAVAILABLE:
            self.close()
            if not self._connected:
                return ServerDied(f"no gRPC server answers at {self._url}: {why}")
            return RequestFailed(f"{self._url} broke the connection: {why}")
        meaning = {
            grpc.StatusCode.DEADLINE_EXCEEDED: f"was silent for too long: {self._wiring.timeout_s:g} s",
            grpc.StatusCode.UNIMPLEMENTED: f"is not a policy server of lerobot's: {why}",
            grpc.StatusCode.RESOURCE_EXHAUSTED: f"answered with more than 4 MiB (see `actions_per_chunk`): {why}",
        }.get(code, f"refused ({code.name}): {why}")
        return RequestFailed(f"{self._url} {meaning}", starting=code is grpc.StatusCode.DEADLINE_EXCEEDED)

    def close(self) -> None:
        if self._channel is not None:
            _LOADED.pop(self._url, None)
            self._channel.close()
            self._channel = None


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Yield the findings that hold for every server of lerobot's; no method is called, as `Ready` would reset it."""
    yield from connect(parts)
    what = "lerobot's policy server answers no sooner than 33 ms after a request, unless it was started otherwise"
    yield Finding("sleep", "advice", what, "start it with --inference_latency=0; runs warn of it (padded-answers)")
    what = "lerobot's policy server drops, silently, an observation without must_go whose state is near the last one's"
    yield Finding("filter", "advice", what, "set must_go, as s2a-bench does, or measure with a state that changes")


def message_of(data: bytes | memoryview, field: int = 1) -> bytes:
    """Return a protobuf message whose one field is these bytes."""
    size, length = bytearray(), len(data)
    while length >= MORE:
        size.append(length % MORE | MORE)
        length //= MORE
    size.append(length)
    return b"".join((bytes((field << 3 | 2,)), size, data))


def bytes_in(message: bytes) -> bytes:
    """Return the bytes of a message that `message_of` could have written; raises RequestFailed."""
    start = next((at + 1 for at, byte in enumerate(message[1:7], 1) if byte < MORE), 0)
    data = message[start:]
    if message_of(data) != message:
        raise RequestFailed(f"{len(message)} bytes that are not a message of lerobot's")
    return data
