"""Observations with unknown keys: which values are pictures, the robot's state, the prompt.

Policies name their keys as they like, so types decide. Every uint8 array is a picture: (H, W, 3) or (3, H, W) pixels in
RGB with any axes of batch and time in front, or (n,) bytes of a JPEG or PNG with axes of length 1 in front, as is every
bytes value. Every float, or array of floats, belongs to the state. The prompt is the text under ``prompt``, else the
first text. The order is that of the keys. Integers and booleans are ignored.

Our client and server add fields to a policy server's protocol, between each other alone. A request has them under the
key `EXTENSION`, which no observation has; the message with the server's marks has the same key. Each protocol decides
how the two recognise each other and when the marks are sent.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from s2a_bench.errors import EngineError, RequestFailed
from s2a_bench.plugins.policy_servers.observation import EXTENSION
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import Limits, check_pixels, read_request, text
from s2a_bench.transport.pictures import decoded
from s2a_bench.transport.serving import Disconnected, Exchange
from s2a_bench.types import Action, Frame, Piece, Request, Vector
from s2a_bench.vectors import state_of

PICTURES, NUMBERS = 64, 4096
"""The most pictures, and numbers of the state, in one request."""
PROMPT: Final = "prompt"
DEPTH: Final = 32
COLOURS: Final = 3


class ActionsExchange(Exchange):
    """A request for actions; those of the answer are kept until its end."""

    parse_stage = "msgpack_parse"

    def __init__(self, trace: Trace | None = None) -> None:
        super().__init__(trace)
        self._actions: list[Vector] = []

    def send(self, piece: Piece) -> bool:
        if self.disconnected():
            raise Disconnected
        if not isinstance(piece, Action):
            raise EngineError(
                "the engine answers with tokens, and this protocol knows actions; choose `answer` actions"
            )
        self._actions.append(piece.values)
        return True

    def chunk(self) -> Vector:
        """Return all actions, (H, D)."""
        if not self._actions:
            raise EngineError("the engine answered with no action at all")
        return np.stack(self._actions)

    def marks(self) -> dict[str, Any]:
        """Return the message with the server's marks, which may take time to find."""
        return {EXTENSION: self.trace.to_remote().to_json()}


def read_observation(
    observation: Any, trace: Trace, limits: Limits
) -> tuple[tuple[Frame, ...], tuple[float, ...], str]:
    """Return pictures as ``rgb8``, state and prompt; marks `image_decode`. Raises RequestFailed with the key."""
    if not isinstance(observation, Mapping):
        raise RequestFailed(f"an observation is a dictionary, not {type(observation).__name__}")
    frames: list[Frame] = []
    numbers: list[Any] = []
    count, first, prompt, pixels = 0, None, None, limits.pixels
    for key, value in _leaves(observation, "", 0):
        if isinstance(value, str):
            first = value if first is None else first
            prompt = value if prompt is None and key.rpartition(".")[2] == PROMPT else prompt
        elif isinstance(value, bytes) or (isinstance(value, np.ndarray) and value.dtype == np.uint8):
            pictures = _pictures(key, value, trace, pixels)
            pixels -= sum(picture.pixel_count for picture in pictures)
            frames += pictures
            if len(frames) > PICTURES:
                raise RequestFailed(f"more than {PICTURES} pictures")
        elif isinstance(value, (float, np.floating)) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
            row = np.asarray(value).reshape(-1)
            count += row.size
            if count > NUMBERS:
                raise RequestFailed(f"{key}: a state of more than {NUMBERS} numbers; pictures are uint8")
            numbers.append(row)
    state = state_of(np.concatenate(numbers)) if count else ()
    return tuple(frames), state, text(PROMPT, prompt if prompt is not None else first)


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield every value that is neither a dictionary nor a list, with its path."""
    if depth > DEPTH:
        raise RequestFailed(f"{path[:80]}: more than {DEPTH} dictionaries and lists in each other")
    if isinstance(value, Mapping):
        for key, each in value.items():
            name = key.decode(errors="replace") if isinstance(key, bytes) else str(key)
            yield from _leaves(each, f"{path}.{name}" if path else name, depth + 1)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _leaves(each, path, depth + 1)
    else:
        yield path, value


def _pictures(key: str, value: Any, trace: Trace, most_pixels: int) -> Sequence[Frame]:
    data = value if isinstance(value, bytes) else value.reshape(-1)
    if data is value or value.ndim == 1 or (len(data) == value.shape[-1] and len(data) != COLOURS):
        if not len(data):
            raise RequestFailed(f"{key}: an empty picture")
        try:
            return [decoded("image", memoryview(data), trace, most_pixels)]
        except RequestFailed as error:
            raise RequestFailed(f"{key}: {error}") from error
    shape = value.shape
    last = value.ndim >= COLOURS and shape[-1] == COLOURS
    if not last and not (value.ndim >= COLOURS and shape[-3] == COLOURS):
        raise RequestFailed(f"{key}: a picture of shape {shape}; they are (H, W, 3), (3, H, W) or a JPEG's bytes")
    height, width = shape[-3:-1] if last else shape[-2:]
    check_pixels(width, height, most_pixels)
    several = value.reshape(-1, *shape[-3:])
    if len(several) > PICTURES:
        raise RequestFailed(f"{key}: {len(several)} pictures; at most {PICTURES} are taken")
    planes = several if last else np.ascontiguousarray(np.moveaxis(several, 1, -1))
    return [Frame(-1, 0, width, height, "rgb8", picture) for picture in planes]


def extension_of(request: Request) -> dict[str, Any]:
    fields = {"id": request.id, "max_tokens": request.max_tokens, "seed": request.seed, "grammar": request.grammar}
    return {name: value for name, value in fields.items() if value}


def take_extension(message: Any) -> dict[Any, Any] | None:
    """Take our client's fields out of a message; None if another client sent it."""
    fields = message.pop(EXTENSION, None) if isinstance(message, dict) else None
    if fields is not None and not isinstance(fields, dict):
        raise RequestFailed(f"{EXTENSION} should be a map")
    return fields


def request_of(observation: Any, extension: dict[Any, Any] | None, trace: Trace, limits: Limits) -> Request:
    """Read an observation and our client's fields, decode its pictures; raises RequestFailed."""
    fields = extension or {}
    images, state, prompt = read_observation(observation, trace, limits)
    name = text("id", fields.get("id")) or "observation-0"
    return read_request(fields, limits, name, prompt, images, state, limits.answer_tokens)


def remote_of(message: Any) -> Remote:
    """Read a server's marks; raises RequestFailed if they are invalid."""
    try:
        return Remote.of_json(message[EXTENSION])
    except (LookupError, TypeError, ValueError) as error:
        raise RequestFailed(f"the server's marks are malformed: {error!r}") from error
