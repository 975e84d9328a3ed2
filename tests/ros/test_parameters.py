"""A node's parameters: what the services of rcl_interfaces answer, on the wire and in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import pytest

from s2a_bench.options import Names, Options, option
from s2a_bench.ros import messages as ros
from s2a_bench.ros.parameters import PARAMETER, SERVICE, Parameters, Type, of_options, value_message


class NodeOptions(Options):
    """Options of every kind."""

    depth: int = option(5, "how deep", ge=1, le=9)
    pace: float = option(0.5, "how fast", ge=0, le=2, flag="max-pace")
    quiet: bool = option(False, "say nothing")
    name: Literal["a", "b"] = option("a", "a or b")
    domain: int | None = option(None, "DDS domain", ge=0, le=232)
    topics: Names = option(("x", "y"), "topics")


class ParameterNode:
    """Calls the services by way of their CDR, as the wire does."""

    def __init__(self) -> None:
        self.options, self.heard = NodeOptions(), list[Any]()
        declared = of_options(self.options, NodeOptions.model_fields, live=("depth", "pace"))
        self.answers = dict(Parameters(declared, self.change, self.heard.extend).services())

    def change(self, wanted: Mapping[str, Any]) -> None:
        self.options = self.options.but(**{"pace" if name == "max_pace" else name: wanted[name] for name in wanted})

    def __call__(self, service: str, **fields: Any) -> Any:
        request = through_cdr(ros.default(f"{SERVICE}{service}_Request", **fields), f"{SERVICE}{service}_Request")
        return through_cdr(self.answers[service](request), f"{SERVICE}{service}_Response")

    def set(self, **values: Any) -> list[tuple[bool, str]]:
        results = self("SetParameters", parameters=parameters(**values)).results
        return [(result.successful, result.reason) for result in results]


def through_cdr(message: Any, type_name: str) -> Any:
    return ros.deserialise(memoryview(bytes(ros.serialise(message, type_name))), type_name)


def parameters(**values: Any) -> list[Any]:
    return [ros.default(PARAMETER, name=name, value=value_message(value)) for name, value in values.items()]


@pytest.fixture
def node() -> ParameterNode:
    return ParameterNode()


NAMES = ["depth", "max_pace", "quiet", "name", "domain", "topics"]


def test_all_are_listed_and_names_have_levels(node: ParameterNode) -> None:
    assert node("ListParameters").result.names == NAMES
    assert node("ListParameters", depth=1, prefixes=["nothing"]).result.names == []
    assert node("ListParameters", prefixes=["depth"]).result.names == ["depth"]


def test_values_have_their_types_and_unknown_ones_are_not_set(node: ParameterNode) -> None:
    values = node("GetParameters", names=[*NAMES, "unknown"]).values
    assert [value.type for value in values] == [2, 3, 1, 4, 0, 9, 0]
    assert (values[0].integer_value, values[1].double_value, values[2].bool_value) == (5, 0.5, False)
    assert (values[3].string_value, values[5].string_array_value) == ("a", ["x", "y"])
    assert node("GetParameterTypes", names=[*NAMES, "unknown"]).types.tolist() == [2, 3, 1, 4, 0, 9, 0]


def test_a_description_says_the_bounds_and_what_can_be_set(node: ParameterNode) -> None:
    depth, pace, quiet, domain, unknown = node(
        "DescribeParameters", names=["depth", "max_pace", "quiet", "domain", "unknown"]
    ).descriptors
    assert (depth.name, depth.type, depth.description, depth.read_only) == ("depth", 2, "how deep", False)
    assert [(each.from_value, each.to_value) for each in depth.integer_range] == [(1, 9)]
    assert [(each.from_value, each.to_value) for each in pace.floating_point_range] == [(0, 2)]
    assert (quiet.read_only, quiet.integer_range) == (True, [])
    assert (domain.dynamic_typing, domain.type) == (True, 0)
    assert (unknown.name, unknown.type) == ("unknown", 0)


def test_what_is_live_is_set_and_said(node: ParameterNode) -> None:
    assert node.set(depth=7, max_pace=1.5) == [(True, ""), (True, "")]
    assert (node.options.depth, node.options.pace) == (7, 1.5)
    assert [value.integer_value for value in node("GetParameters", names=["depth"]).values] == [7]
    assert [(each.name, each.value.type) for each in node.heard] == [("depth", 2), ("max_pace", 3)]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"depth": 10}, "`depth`: 10 should be less than or equal to 9"),
        ({"max_pace": float("nan")}, "`pace`: nan should be"),
        ({"depth": 1.5}, "depth is of type INTEGER, not DOUBLE"),
        ({"depth": None}, "depth is of type INTEGER, not NOT_SET"),
        ({"quiet": True}, "quiet is read-only"),
        ({"unknown": 1}, "no parameter 'unknown'"),
    ],
)
def test_what_cannot_be_set_stays_and_the_reason_is_told(
    node: ParameterNode, values: dict[str, Any], reason: str
) -> None:
    ((successful, said),) = node.set(**values)
    assert not successful
    assert reason in said
    assert node.options == NodeOptions()
    assert not node.heard


def test_atomically_is_all_or_nothing(node: ParameterNode) -> None:
    result = node("SetParametersAtomically", parameters=parameters(depth=3, max_pace=3.0)).result
    assert not result.successful
    assert node.options == NodeOptions()
    assert node("SetParametersAtomically", parameters=parameters(depth=3, max_pace=1.0)).result.successful
    assert (node.options.depth, node.options.pace) == (3, 1.0)


def test_an_impossible_type_is_refused(node: ParameterNode) -> None:
    strange = ros.default(PARAMETER, name="depth", value=ros.default("rcl_interfaces/msg/ParameterValue", type=77))
    assert "77 is not a type" in node("SetParameters", parameters=[strange]).results[0].reason


def test_types_are_numbered_as_in_ros() -> None:
    constants = ros.typestore().fielddefs["rcl_interfaces/msg/ParameterType"][0]
    assert {name.removeprefix("PARAMETER_"): number for name, _, number in constants} == {
        kind.name: int(kind) for kind in Type
    }
