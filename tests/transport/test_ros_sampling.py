"""What goals want of sampling: honoured where the engine can, and named in the log once where not."""

from __future__ import annotations

import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.inference import ENGINES
from s2a_bench.ros.llama import GENERATE_RESPONSE, generate_goal
from s2a_bench.ros.messages import VERSIONS, default, deserialise, serialise
from s2a_bench.transport.ros.action import BOUNDS, Wishes

HONOURED = ENGINES["llama"].honours


@pytest.mark.parametrize("version", VERSIONS)
def test_a_client_that_does_not_care_wants_nothing(version: str, caplog: pytest.LogCaptureFixture) -> None:
    type_name = GENERATE_RESPONSE + "_Goal"
    goal = deserialise(
        memoryview(serialise(generate_goal("p", version=version), type_name, version)), type_name, version
    )
    assert Wishes(HONOURED, version).of(goal.sampling_config) == ()
    assert not caplog.records


def test_numbers_that_differ_from_the_default_are_wanted_under_their_names() -> None:
    goal = generate_goal("p", temp=0.0, top_k=3, mirostat=2, grammar='root ::= "a"', seed=7)
    assert Wishes(HONOURED, "6.0").of(goal.sampling_config) == (("temp", 0.0), ("top_k", 3), ("mirostat", 2))


def test_what_the_engine_does_not_honour_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    wishes = Wishes(("temp",), "6.0")
    bias = default("llama_msgs/msg/LogitBiasArray", data=[default("llama_msgs/msg/LogitBias", token=1, bias=2.0)])
    for config in ({"dry_multiplier": 0.8, "logit_bias": bias}, {"dry_multiplier": 0.5, "top_k": 3}, {"top_k": 4}):
        assert wishes.of(generate_goal("p", **config).sampling_config) == ()
    assert [record.getMessage().partition(": ")[2] for record in caplog.records] == [
        "logit_bias, dry_multiplier",
        "top_k",
    ]


@pytest.mark.parametrize(
    ("name", "value"),
    [("temp", float("nan")), ("temp", -1.0), ("top_p", 1.5), ("penalty_repeat", 0.0), ("mirostat", 3), ("top_k", -2)],
)
def test_numbers_that_make_no_sense_fail_the_goal(name: str, value: float) -> None:
    with pytest.raises(RequestFailed, match=rf"sampling_config\.{name}: .* is not "):
        Wishes(HONOURED, "6.0").of(generate_goal("p", **{name: value}).sampling_config)


def test_whatever_the_llama_engine_honours_has_bounds() -> None:
    assert set(HONOURED) == set(BOUNDS)
    assert not ENGINES["echo"].honours
