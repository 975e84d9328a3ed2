"""Policies with parameters, as users write them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Annotated, ClassVar, Literal

import pytest
from pydantic import Field

from s2a_bench.cli import with_flags
from s2a_bench.errors import UsageError
from s2a_bench.policy import POLICIES, PlanShape, Policy, Stepper, policies, policy
from s2a_bench.policy.nominal import Naive, NominalQueue
from s2a_bench.policy.stream_to_act import StreamToAct


@dataclass(frozen=True)
class Toy(Policy):
    """What another package might offer."""

    name: ClassVar[str] = "toy"
    factor: Annotated[int, Field(ge=1, le=9)] = 1
    mood: Literal["calm", "brisk"] = "calm"
    late: bool = False

    def __post_init__(self) -> None:
        if self.late and self.factor == 9:
            raise UsageError("a late toy has a factor below 9")

    def stepper(self, shape: PlanShape) -> Stepper:  # noqa: ARG002
        return NominalQueue()


@pytest.fixture(autouse=True)
def offer(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("toy", f"{__name__}:Toy", POLICIES.group)
    monkeypatch.setattr(EntryPoint, "load", lambda _: Toy)
    monkeypatch.setitem(vars(POLICIES), "_offered", {"toy": point})


def test_parameters_are_the_fields_of_the_policy() -> None:
    assert policy("naive") == Naive()
    assert policy("stream-to-act?caution=1.5") == StreamToAct(caution=1.5)
    assert policy("stream-to-act?caution=inf") == StreamToAct(caution=math.inf)
    assert policy("toy?late=true&factor=3&mood=brisk") == Toy(3, "brisk", late=True)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("naive", "naive"),
        ("naive?", "naive"),
        ("toy?mood=brisk&factor=02", "toy?factor=2&mood=brisk"),
        ("toy?factor=1&mood=calm", "toy"),
        ("stream-to-act?caution=2.0", "stream-to-act?caution=2"),
        ("stream-to-act?caution=2.33", "stream-to-act?caution=2.33"),
        ("s2a-mean?caution=0", "s2a-mean"),
    ],
)
def test_a_name_has_its_parameters_in_order_and_no_defaults(written: str, name: str) -> None:
    assert list(policies([written])) == [name]
    assert policies([name]) == policies([written])


def test_two_ways_to_write_one_policy_are_one() -> None:
    assert list(policies(["toy", "toy?factor=2", "toy?factor=1", "toy?factor=2&late=0"])) == ["toy", "toy?factor=2"]


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("naive?x=1", "naive: 'x' is not a parameter; it has no parameters"),
        ("toy?size=1", "toy: 'size' is not a parameter; its parameters are factor, mood, late"),
        ("toy?factor=2&factor=3", "toy: 'factor' is given twice; its parameters are"),
        ("toy?factor=0", "toy: factor = '0': input should be greater than or equal to 1; its parameters are"),
        ("toy?factor=two", "toy: factor = 'two': input should be a valid integer"),
        ("toy?mood", "toy: mood = '': input should be 'calm' or 'brisk'"),
        ("stream-to-act?caution=-1", "caution = '-1': input should be greater than or equal to 0"),
        ("stream-to-act?caution=nan", "caution = 'nan': input should be greater than or equal to 0"),
        ("toy?late=1&factor=9", "toy: a late toy has a factor below 9; its parameters are factor, mood, late"),
        ("stream-to-act?prior=1", "stream-to-act: 'prior' is not a parameter; its parameters are caution"),
    ],
)
def test_wrong_parameters_are_one_line_that_names_policy_parameter_and_choice(written: str, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        policy(written)
    assert message in str(caught.value)
    assert with_flags(str(caught.value)).startswith("--policy: ")
