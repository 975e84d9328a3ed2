"""The ROS variant `topic`: requests go to ``<namespace>/request``, tokens return on ``<namespace>/token``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from secrets import token_hex
from typing import Any

from s2a_bench.errors import MessagesLost, RequestFailed, ServerDied
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.ros import Middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.service import REACH_S, READER_QOS, appeared
from s2a_bench.trace import Trace
from s2a_bench.transport.limits import Bounds, Limits, whole_number
from s2a_bench.transport.ros import wire
from s2a_bench.transport.ros.camera import picture_message, pictures_of
from s2a_bench.transport.ros.exchange import RosExchange, Shared
from s2a_bench.transport.ros.joining import RosClient
from s2a_bench.types import Piece, Request, Token
from s2a_bench.vectors import state_of


class TopicClient(RosClient):
    def _meet_server(self, namespace: str) -> None:
        # announced first: a server that knows the requests' writer should know the tokens' reader as well
        self._subscription = self.middleware.subscription(namespace + "/token", ros.TOKEN, READER_QOS)
        self._publisher = self.middleware.publisher(namespace + "/request", ros.REQUEST, wire.REQUEST_QOS)
        ends = (self._publisher, self._subscription)  # volatile: what is sent before they match is lost
        self.wait_until(lambda: all(end.matched() for end in ends), f"no server appeared under {namespace}")

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        images: dict[str, list[Any]] = {ros.IMAGE: [], ros.COMPRESSED_IMAGE: []}
        for frame in request.images:
            type_name, message = picture_message(frame, self._wiring.options.payload, self._offset_ns, trace)
            images[type_name].append(message)
        name = f"{request.id}#{token_hex(16)}"  # no other node can answer before it has heard it
        message = wire.request_message(replace(request, id=name), images[ros.IMAGE], images[ros.COMPRESSED_IMAGE])
        packed = self._publisher.pack(message)
        trace.mark("cdr_pack")
        self._publisher.send(packed)
        trace.facts[PAYLOAD_BYTES] = len(packed)
        bounds = self._wiring.bounds("the server", request.max_tokens)
        expected = 0
        while True:
            token = self._next(name, trace, bounds)
            if token.index != expected:
                raise MessagesLost(
                    f"piece {token.index} came instead of {expected}: messages were lost, or two servers answer"
                )
            if token.last:
                break
            pieces = wire.pieces_of(token)
            if not expected:
                trace.mark("return")
            yield from pieces
            expected += len(pieces)
        if token.marks:
            trace.receive(wire.remote_of(token.marks[0]))
        if token.error:
            raise RequestFailed(f"the server broke off: {token.error}")

    def _next(self, name: str, trace: Trace, bounds: Bounds) -> Any:
        """Wait for the next token of this request; drop other clients' messages and malformed ones."""
        for packed in self.taken(self._subscription.take, bounds):
            if packed is not None:
                token = wire.readable(self._subscription, packed, trace)
                if token is not None and token.id == name:
                    bounds.count_bytes(len(packed))
                    return token
            elif not self._alive():
                raise ServerDied("the server's process has ended")
        raise RequestFailed(f"no token for {self._wiring.timeout_s:.0f} s")


class TopicSource:
    def __init__(self, middleware: Middleware, namespace: str, limits: Limits) -> None:
        self.limits = limits
        self._requests = middleware.subscription(namespace + "/request", ros.REQUEST, READER_QOS)
        self._tokens = middleware.publisher(namespace + "/token", ros.TOKEN, wire.TOKEN_QOS)
        self._reached: set[Any] = set()
        self.take, self.sender, self.interrupt = self._requests.take, self._requests.sender, self._requests.interrupt

    def exchange(self, packed: Any, shared: Shared, trace: Trace) -> TopicExchange:
        """Unpack a request; raises TransportError for malformed bytes."""
        message = self._requests.unpack(packed)
        trace.mark("cdr_parse")
        return TopicExchange(self, message, shared, trace)

    def size_bytes(self, packed: Any) -> int:
        return len(packed)

    def refuse(self, packed: Any, why: str) -> None:
        """Answer a request with an error only; raises TransportError for malformed bytes."""
        request_id = self._requests.unpack(packed).id
        marks = [wire.marks_message(request_id, Trace().to_remote())]
        self.send(request_id, self.sender(), Token(0, "", -1), marks, why)

    def send(self, request_id: str, sender: Any, token: Piece, marks: list[Any], error: str = "") -> None:
        """Publish one token, or with marks the end of the answer; the first to a client waits for its reader.

        Tokens are volatile: one that is sent before the reader is matched is lost.
        """
        if sender not in self._reached:
            appeared(lambda: self._requests.sender_hears(sender, self._tokens), REACH_S)
            self._reached.add(sender)
        message = wire.token_message(request_id, token, last=bool(marks), error=error, marks=marks)
        self._tokens.send(self._tokens.pack(message))


class TopicExchange(RosExchange):
    def __init__(self, source: TopicSource, message: Any, shared: Shared, trace: Trace) -> None:
        super().__init__(shared, trace)
        self._source, self._message = source, message
        self._id, self._sender = str(message.id), source.sender()
        self._sent = 0

    def request(self) -> Request:
        message, limits = self._message, self._source.limits
        whole_number("max_tokens", int(message.max_tokens), 1, limits.answer_tokens, 0)
        images = pictures_of((*message.images, *message.compressed_images), self.trace, limits)
        name, state = message.id.rpartition("#")[0] or message.id, state_of(message.state)
        return Request(name, message.prompt, images, message.max_tokens, message.grammar, message.seed, state=state)

    def piece(self, piece: Piece) -> bool:
        self._source.send(self._id, self._sender, piece, [])
        self._sent += 1
        return True

    def finish(self, error: str) -> None:
        marks = wire.marks_message(self._id, self.trace.to_remote())
        self._source.send(self._id, self._sender, Token(self._sent, "", -1), [marks], error)
