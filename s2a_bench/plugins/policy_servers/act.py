"""OpenVLA's ``/act``: an array of pixels in, an array of actions out, by json_numpy; nothing is streamed.

The whole action is one token, so its time to first token is that of the answer. With a template (OpenVLA-OFT, X-VLA)
the request is its observation, and the answer a chunk of actions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.facts import Fact
from s2a_bench.plugins.policy_servers.observation import Template, template_of
from s2a_bench.plugins.policy_servers.policies import PolicyTransport, TemplateOptions
from s2a_bench.trace import Trace
from s2a_bench.transport import ACTIONS
from s2a_bench.transport.http.dialects import Event
from s2a_bench.transport.http.dialects.common import Dialect
from s2a_bench.transport.http.dialects.framing import WholeBody
from s2a_bench.types import Pixels, Request
from s2a_bench.vectors import actions_of

FAILED = "error"
"""The body of a failure, with status 200 (``vla-scripts/deploy.py``)."""

ACTION_N = Fact("action_n", "", "numbers of the action")

ARRAY = "__numpy__"
"""The key of an array's bytes, in Base64."""

NUMBERS = re.compile(r"[<>|=]?[fiu][0-9]+")


class OpenVla(Dialect):
    """An action server; a request's model is its ``unnorm_key``."""

    name = "openvla"
    path = "/act"
    lists_models = False
    takes_task = True
    media_type = "application/json"
    payloads: tuple[str, ...] = ("raw",)
    framing = WholeBody
    facts = (ACTION_N,)
    options = TemplateOptions
    packages = ("json-numpy",)

    def __init__(self) -> None:
        self._template: Template | None = None

    def configure(self, options: Any) -> None:
        extras.require("json_numpy", "act")
        if not options.template:
            return
        self._template = template = template_of(options.template)
        template.check_server(self.name, ("path", "answer", "arrays_as_text", "arrays_as_lists"))
        self.path = template.server.path or self.path
        self.answer_kinds, self.accepts_state = (ACTIONS,), template.accepts_state
        self.payloads = PolicyTransport.payloads[1:] if template.encoded else self.payloads

    def check(self, cameras: int, state: int) -> None:
        if self._template is not None:
            self._template.check_request(cameras, state)

    def fields(
        self, request: Request, payload: str, model: str, to_base64: Callable[[Pixels], str], trace: Trace
    ) -> dict[str, Any]:
        """Return the template's observation, OpenVLA's own without one, in the form of ``json_numpy.dumps``."""
        from s2a_bench.plugins.policy_servers.policy_client import policy_picture

        template, frames = self._template, request.images if self._template else request.images[:1]
        pictures = [policy_picture(frame, payload, trace) for frame in frames]
        filled: dict[str, Any] = {"instruction": request.prompt} | ({"image": pictures[0]} if pictures else {})
        if template:
            filled = template.fill(pictures, request.state, request.prompt)

        def sendable(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: sendable(each) for key, each in value.items()}
            if isinstance(value, list):
                return [sendable(each) for each in value]
            if isinstance(value, bytes):
                value = np.frombuffer(value, np.uint8)
            if not isinstance(value, np.ndarray):
                return value
            if template and template.server.arrays_as_lists:
                return value.tolist()
            data = np.ascontiguousarray(value).reshape(-1).view(np.uint8)
            array = {ARRAY: to_base64(data), "dtype": value.dtype.str, "shape": value.shape}
            return json.dumps(array) if template and template.server.arrays_as_text else array

        observation: dict[str, Any] = sendable(filled)
        trace.mark("base64_encode")
        return {**observation, "unnorm_key": model} if model else observation

    def event(self, message: Any) -> Event:
        """Read the action: an array, an array in a JSON text (a server that was sent ``encoded``), or a list of them.

        With a template read the actions from where it says they are.
        """
        if message == FAILED:
            return Event(error="the server answered 'error'; the reason is in the server's output")
        if isinstance(message, str):
            message = json.loads(message)
        if self._template is not None:
            actions = actions_of(_arrays_in(self._template.server.actions_in(message)))
            count = float(sum(action.values.size for action in actions))
            return Event(finish="stop", facts={ACTION_N: count}, actions=actions)
        action = np.asarray(_arrays_in(message), np.float64)
        if not (action.size and np.isfinite(action).all()):
            raise ValueError("an action that is not a list of finite numbers")
        return Event(json.dumps(action.tolist()), finish="stop", facts={ACTION_N: float(action.size)})


def _arrays_in(value: Any) -> Any:
    """Return a value with NumPy's arrays in place of json_numpy's, also of those in lists and objects."""
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return [_arrays_in(each) for each in value]
    if not isinstance(value, dict):
        return value
    if ARRAY not in value:
        return {key: _arrays_in(each) for key, each in value.items()}
    if not NUMBERS.fullmatch(value["dtype"]):
        raise ValueError(f"an action of type {value['dtype']}")
    return extras.require("json_numpy", "act").object_hook(value)
