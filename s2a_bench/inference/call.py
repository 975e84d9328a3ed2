"""An engine that is a user's Python function: an expert, a replayed demonstration, a policy of any framework."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from s2a_bench.errors import EngineError, RequestFailed
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.policy.parameters import build
from s2a_bench.registry import check_function, function_of
from s2a_bench.types import Action, Request
from s2a_bench.vectors import actions_of


@dataclass(frozen=True, slots=True)
class Called:
    """The parameters: ``function`` is written ``module:name``."""

    function: str = ""

    def __post_init__(self) -> None:
        check_function(self.function)


class CallEngine(Engine):
    """Answers with the actions of a function ``(pictures, state, prompt)``, loaded in the server's process.

    ``pictures`` is a tuple of RGB pictures, uint8 (height, width, 3), ``state`` the robot's, float32 (S,), ``prompt`` a
    text. The function returns a chunk of actions, (H, D) or (D,), or yields actions (D,), each of which leaves at once.
    """

    acts = True
    speaks = False
    needs_model = False
    parameters = Called
    risk = "program"

    def __init__(self, config: EngineConfig) -> None:
        self._name = build(Called, config.name, "engine").function
        self._function = function_of(self._name, "`engine`: call")

    def generate(self, request: Request) -> Iterator[Action]:
        self.need_open()
        if request.max_tokens <= 0:
            return
        try:
            pictures = tuple(frame.data for frame in request.images)
            answer = self._function(pictures, np.array(request.state, np.float32), request.prompt)
            chunk: Iterator[Action]
            if isinstance(answer, Iterator):
                chunk = (action for index, row in enumerate(answer) for action in actions_of(row, index))
            else:
                chunk = iter(actions_of(answer))
            yield from islice(chunk, request.max_tokens)
        except RequestFailed as error:
            raise EngineError(f"call: {self._name} answered with {error}") from error
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            raise EngineError(f"call: {self._name}: {type(error).__name__}: {error}") from error

    def describe(self) -> dict[str, str | int | float | bool]:
        return {"engine": "call", "model": self._name, "grammar": "ignored"}
