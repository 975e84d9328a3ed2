"""A user's function as a policy behind our servers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import EngineError, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.provenance import Provenance
from s2a_bench.testing.engine import EngineSuite, rgb_frame
from s2a_bench.types import Request

POLICY = "call?function=somebodys_policy:act"


def policy(act: object) -> Engine:
    module = ModuleType("somebodys_policy")
    module.act = act  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "somebodys_policy", module)
        return open_engine(EngineConfig(name=POLICY))


def asked(engine: Engine, **more: Any) -> list[list[float]]:
    request = Request("r", "close the drawer", **{"max_tokens": 9, "state": (1.0, 2.0), **more})
    return [piece.values.tolist() for piece in engine.generate(request)]  # type: ignore[union-attr]


class TestCall(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return policy(lambda *_: np.ones((9, 3)))

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


def test_the_function_sees_pictures_state_and_prompt() -> None:
    seen: list[Any] = []
    frames = (rgb_frame(1), rgb_frame(2))
    engine = policy(lambda *given: seen.append(given) or [0.0])
    asked(engine, images=frames)
    ((pictures, state, prompt),) = seen
    assert [(each == frame.data).all() for each, frame in zip(pictures, frames, strict=True)] == [True, True]
    assert state.dtype == np.float32
    assert state.tolist() == [1, 2]
    assert prompt == "close the drawer"


@pytest.mark.parametrize(
    ("answer", "actions"),
    [([[1, 2], [3, 4]], [[1, 2], [3, 4]]), (np.array([5, 6]), [[5, 6]]), ([[[7], [8]]], [[7], [8]])],
)
def test_a_chunk_or_one_action_is_answered(answer: object, actions: list[list[float]]) -> None:
    assert asked(policy(lambda *_: answer)) == actions


def test_a_generator_s_actions_leave_one_by_one_and_no_more_than_are_asked_for() -> None:
    made: list[int] = []

    def act(*_: object) -> Iterator[list[int]]:
        for index in range(1000):
            made.append(index)
            yield [index, -index]

    engine = policy(act)
    pieces = engine.generate(Request("r", "go", max_tokens=3))
    assert next(pieces).index == 0
    assert made == [0]
    assert [piece.index for piece in pieces] == [1, 2]
    assert len(made) <= 4


def boom(*_: object) -> None:
    raise KeyError("gripper")


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (boom, "call: somebodys_policy:act: KeyError: 'gripper'"),
        (lambda: 0, "call: somebodys_policy:act: TypeError: "),
        (lambda *_: "left", "call: somebodys_policy:act answered with actions: shape () and type <U4, not numbers"),
        (lambda *_: np.full((2, 3), np.nan), "call: somebodys_policy:act answered with actions: not finite numbers"),
        (lambda *_: iter([[1.0], "left"]), "call: somebodys_policy:act answered with actions: shape ()"),
    ],
)
def test_a_function_that_fails_is_one_line(act: object, message: str) -> None:
    with pytest.raises(EngineError) as error:
        asked(policy(act))
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"name": "call"}, "`engine`: call: function = '' should look like module:name"),
        ({"name": "call?funktion=a:b"}, "`engine`: call: 'funktion' is not a parameter; its parameters are function"),
        ({"name": "echo?function=a:b"}, "`engine`: echo: 'function' is not a parameter; it has no parameters"),
        ({"name": "calls"}, "`name`: 'calls' is not one of llama, echo, replay, call"),
        ({"name": "call?function=no_such_policy:act"}, "`engine`: call: no_such_policy:act does not load: ModuleNotF"),
        ({"name": POLICY, "answer": "tokens"}, "`answer` tokens: `engine` call answers with actions alone"),
        ({"name": POLICY, "gpu_layers": 3}, "`gpu_layers` is for an engine with a model"),
    ],
)
def test_wrong_usage_is_one_line(given: dict[str, Any], message: str) -> None:
    def opened() -> None:
        open_engine(LatencyConfig(engine=given).engine)

    with pytest.raises(UsageError) as error:
        opened()
    assert str(error.value).startswith(message)


def test_it_answers_with_actions_unasked_and_names_code_to_run() -> None:
    config = LatencyConfig(engine={"name": POLICY}, transports=("http/as-deployed",))
    assert config.answer == "actions"
    assert ("engine", "program", POLICY) in list(config.risks())
    assert not list(LatencyConfig(engine={"name": "echo"}).risks())


def test_its_weights_are_unknown() -> None:
    origin = Provenance.of_engine(policy(lambda *_: [0.0]).describe(), link="real")
    assert origin.line == "call (somebodys_policy:act, weights unknown), tokens measured"
