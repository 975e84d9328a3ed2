"""OpenVLA's ``/act``: an array of pixels in, an array of actions out, by json_numpy; nothing is streamed.

The whole action is one token, so its time to first token is that of the answer.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.facts import Fact
from s2a_bench.frames.convert import to_rgb
from s2a_bench.trace import Trace
from s2a_bench.transport.http.dialects import EncodedPicture, Event
from s2a_bench.transport.http.dialects.common import Dialect
from s2a_bench.transport.http.dialects.framing import WholeBody
from s2a_bench.types import Frame, Pixels, Request

json_numpy = extras.require("json_numpy", "openvla")

FAILED = "error"
"""The body of a failure, with status 200 (``vla-scripts/deploy.py``)."""

ACTION_N = Fact("action_n", "", "numbers of the action")

NUMBERS = re.compile(r"[<>|=]?[fiu][0-9]+")


class OpenVla(Dialect):
    """An action server; a request's model is its ``unnorm_key``."""

    name = "openvla"
    path = "/act"
    lists_models = False
    media_type = "application/json"
    payloads = ("raw",)
    framing = WholeBody
    facts = (ACTION_N,)

    def encode(self, frame: Frame, payload: str, trace: Trace) -> tuple[str, Pixels]:  # noqa: ARG002 - always pixels
        """Return the pixels as RGB, height x width x 3, marking `convert`."""
        if frame.encoding == "rgb8":
            return "", frame.data
        pixels = to_rgb(frame)
        trace.mark("convert")
        return "", pixels

    def body(self, request: Request, pictures: list[EncodedPicture], model: str) -> dict[str, Any]:
        """Return the array in the form of ``json_numpy.dumps``, and the instruction."""
        fields: dict[str, Any] = {"instruction": request.prompt}
        if model:
            fields["unnorm_key"] = model
        for picture in pictures[:1]:
            fields["image"] = {"__numpy__": picture.base64, "dtype": "|u1", "shape": picture.shape}
        return fields

    def event(self, message: Any) -> Event:
        """Read the action: an array, an array in a JSON text (a server that was sent ``encoded``), or a list."""
        if message == FAILED:
            return Event(error="the server answered 'error'; the reason is in the server's output")
        if isinstance(message, str):
            message = json.loads(message)
        if isinstance(message, dict):
            if not NUMBERS.fullmatch(message["dtype"]):
                raise ValueError(f"an action of type {message['dtype']}")
            message = json_numpy.object_hook(message)
        action = np.asarray(message, np.float64)
        if not (action.size and np.isfinite(action).all()):
            raise ValueError("an action that is no finite numbers")
        return Event(json.dumps(action.tolist()), finish="stop", facts={ACTION_N: float(action.size)})
