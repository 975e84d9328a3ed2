"""A policy server as lerobot's: its four methods on grpcio, its pickles, its one observation and one policy.

It unpickles what comes, as the real one, with stand-ins for lerobot's classes; what it sends is written by hand.
"""

from __future__ import annotations

import pickle
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from queue import Empty, Queue
from threading import Event
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np

HELPERS = "lerobot.async_inference.helpers"
END = 3


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def number(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def plain(value: Any) -> bytes:
    """A pickle, as those at the head of torch's legacy format."""
    return pickle.dumps(value, 2)


def storage(numbers: np.ndarray[Any, Any], count: int | None = None, kind: str = "FloatStorage") -> bytes:
    """The bytes that torch's `_load_from_bytes` reads."""
    size = numbers.size if count is None else count
    described = b"(" + text("storage") + name("torch", kind) + text("0") + text("cpu") + number(size) + b"NtQ."
    head = [plain(0x1950A86A20F9469CFC6C), plain(1001), plain({"protocol_version": 1001, "little_endian": True})]
    return b"".join([*head, b"\x80\x02", described, plain(["0"]), struct.pack("<q", size), numbers.tobytes()])


def action(stamp: float, kept: bytes, offset: int, length: int, stride: int = 1) -> bytes:
    """The opcodes of one TimedAction, whose numbers are in a storage."""
    loaded = name("torch.storage", "_load_from_bytes") + b"(B" + struct.pack("<I", len(kept)) + kept + b"tR"
    shape = number(offset) + number(length) + b"\x85" + number(stride) + b"\x85\x89"
    tensor = name("torch._utils", "_rebuild_tensor_v2") + b"(" + loaded + shape
    tensor += name("collections", "OrderedDict") + b")RtR"
    return timed_action(stamp, tensor)


def timed_action(stamp: float, tensor: bytes) -> bytes:
    fields = text("timestamp") + b"G" + struct.pack(">d", stamp) + text("timestep") + number(0) + text("action")
    return name(HELPERS, "TimedAction") + b")\x81}(" + fields + tensor + b"ub"


def answer(*actions: bytes) -> bytes:
    return b"\x80\x04](" + b"".join(actions) + b"e."


def chunk(stamp: float, rows: np.ndarray[Any, Any]) -> bytes:
    """What `GetActions` pickles: each action has a copy of the whole chunk's storage."""
    kept = storage(rows)
    return answer(*(action(stamp, kept, index * rows.shape[1], rows.shape[1]) for index in range(len(rows))))


class _StandIns(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        return type(name, (SimpleNamespace,), {}) if module == HELPERS else super().find_class(module, name)


def field_of(message: bytes, number: int) -> bytes:
    """The bytes of a message's field, as protobuf has them; the fields before it are varints."""
    at, value = 0, 0
    while at < len(message):
        tag, value, shift = message[at], 0, 0
        at += 1
        while True:
            value |= (message[at] & 0x7F) << shift
            shift, at = shift + 7, at + 1
            if not message[at - 1] & 0x80:
                break
        if tag == number << 3 | 2:
            return message[at : at + value]
    return b""


def message_of(data: bytes) -> bytes:
    size, length = b"", len(data)
    while length > 0x7F:
        size, length = size + bytes((length & 0x7F | 0x80,)), length >> 7
    return b"\x0a" + size + bytes((length,)) + data


@dataclass
class PolicyServer:
    """The handlers, and what they got; ``replies`` makes the answer of an observation: None is `Empty`."""

    replies: Callable[[Any], bytes | None]
    asked: Event = field(default_factory=Event)
    policies: list[Any] = field(default_factory=list)
    observations: list[Any] = field(default_factory=list)
    states: list[list[int]] = field(default_factory=list)
    queue: Queue[Any] = field(default_factory=lambda: Queue(1))

    def ready(self, _request: bytes, _context: Any) -> bytes:
        self.queue = Queue(1)
        return b""

    def instructions(self, request: bytes, _context: Any) -> bytes:
        policy = _StandIns(BytesIO(field_of(request, 1))).load()
        if policy.policy_type != "act":
            raise ValueError(f"Policy type {policy.policy_type} not supported")
        self.policies.append(policy)
        return b""

    def observe(self, requests: Iterator[bytes], _context: Any) -> bytes:
        """Wait, unlike the real one, until somebody waits for the actions: the client has to ask before it sends."""
        pieces = list(requests)
        self.states.append([piece[1] for piece in pieces])
        observation = _StandIns(BytesIO(b"".join(field_of(piece, 2) for piece in pieces))).load()
        assert self.asked.wait(20)
        self.observations.append(observation)
        self.queue.put(observation)
        return b""

    def actions(self, _request: bytes, _context: Any) -> bytes:
        self.asked.set()
        try:
            reply = self.replies(self.queue.get(timeout=20))
        except Empty:
            return b""
        finally:
            self.asked.clear()
        return b"" if reply is None else message_of(reply)

    def handlers(self) -> Any:
        unary, stream = grpc.unary_unary_rpc_method_handler, grpc.stream_unary_rpc_method_handler
        methods = {
            "Ready": unary(self.ready),
            "SendPolicyInstructions": unary(self.instructions),
            "SendObservations": stream(self.observe),
            "GetActions": unary(self.actions),
        }
        return grpc.method_handlers_generic_handler("transport.AsyncInference", methods)


@contextmanager
def grpc_server(handlers: Sequence[Any] = (), port: int = 0) -> Iterator[str]:
    """A gRPC server on grpcio: its URL."""
    server = grpc.server(ThreadPoolExecutor(4), handlers=handlers)
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    try:
        yield f"grpc://127.0.0.1:{port}"
    finally:
        server.stop(0).wait(20)


def main() -> None:
    """Serve chunks of 16 x 7 at once, at the port of the command line, until it ends."""
    rows = np.zeros((16, 7), np.float32)
    server = PolicyServer(lambda observation: chunk(observation.timestamp, rows))
    with grpc_server([server.handlers()], int(sys.argv[1])):
        Event().wait()


if __name__ == "__main__":
    main()
