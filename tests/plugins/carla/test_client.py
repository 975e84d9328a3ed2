"""What the real client knows without a server: the road, names and arguments of the calls, and that nobody answers."""

from __future__ import annotations

import inspect
import re
import socket
from typing import Any

import pytest

from s2a_bench.errors import SimulatorError
from s2a_bench.plugins.carla.world import MIDDLE_M, OPENDRIVE, ROAD_M
from s2a_bench.scenario import LANE_WIDTH_M, open_simulator
from tests.plugins.carla.stand_in import CLASSES

carla: Any = pytest.importorskip("carla", reason="the client, pip install '.[carla]', is not installed")
MM = 1e-3


@pytest.fixture(scope="module")
def road() -> Any:
    return carla.Map("straight", OPENDRIVE)


@pytest.mark.parametrize(("lane", "y"), [(-1, MIDDLE_M - LANE_WIDTH_M), (-2, MIDDLE_M), (-3, MIDDLE_M + LANE_WIDTH_M)])
def test_the_road_has_three_straight_lanes(road: Any, lane: int, y: float) -> None:
    start = road.get_waypoint(carla.Location(200.0, y + 1.0, 0.0))
    assert (start.lane_id, str(start.lane_type), start.lane_width) == (lane, "Driving", LANE_WIDTH_M)
    for along in (0.1, 250.0, 500.0, 1000.0):
        (point,) = start.next(along)
        at, facing = point.transform.location, point.transform.rotation
        assert (at.x, at.y, at.z) == pytest.approx((200.0 + along, y, 0.0), abs=MM)
        assert (facing.yaw, facing.pitch, facing.roll) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def test_the_left_lane_of_the_start_may_be_changed_to_and_the_road_ends_where_it_says(road: Any) -> None:
    start = road.get_waypoint(carla.Location(250.0, MIDDLE_M, 0.0))
    assert start.get_left_lane().transform.location.y == pytest.approx(MIDDLE_M - LANE_WIDTH_M, abs=MM)
    assert start.left_lane_marking.type == carla.LaneMarkingType.Broken
    assert road.get_waypoint_xodr(1, -2, ROAD_M - 0.1).transform.location.x == pytest.approx(ROAD_M - 0.1, abs=MM)
    assert road.get_waypoint_xodr(1, -2, ROAD_M + 0.1) is None
    assert road.get_waypoint(carla.Location(250.0, -1.0, 0.0), project_to_road=False) is None


MADE_BY_THE_SERVER = {"Actor", "Vehicle", "ActorBlueprint", "CollisionEvent", "Image"}
OF_THE_STAND_IN = {("Vehicle", "tick"), ("Sensor", "callback"), ("ActorBlueprint", "attributes")}


def offered(kind: type) -> list[str]:
    """Return the methods, properties and fields of a class of the stand-in."""
    every = {*vars(kind), *getattr(kind, "__annotations__", {})}
    return [name for name in every if name[0] != "_" and (kind.__name__, name) not in OF_THE_STAND_IN]


def overloads(function: Any) -> list[list[str]]:
    """Return the names of the arguments after the first of a function of the client, from its docstring."""
    lines = re.findall(rf"^{function.__name__}\(.*\) ?->.*$", function.__doc__ or "", re.MULTILINE)
    return [re.findall(r"\(\w+\)(\w+)", line)[1:] for line in lines]


def fits(function: Any, known: list[str]) -> bool:
    """Return whether every call of the stand-in's function would suit an overload; the client's arg2 has no name."""
    taken = list(inspect.signature(function).parameters.values())[1:]
    in_order = [each.name for each in taken if each.kind is not each.KEYWORD_ONLY]
    by_name = {each.name for each in taken} - {*in_order}
    pairs = zip(in_order, known, strict=False)
    return (
        len(in_order) <= len(known)
        and by_name <= {*known}
        and all(given == other or re.fullmatch(r"arg\d", other) for given, other in pairs)
    )


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_the_stand_in_offers_nothing_that_the_client_has_not_in_its_names_and_order(kind: type) -> None:
    real = getattr(carla, kind.__name__)
    assert [name for name in offered(kind) if not hasattr(real, name)] == []
    made = [] if kind.__name__ in MADE_BY_THE_SERVER or "__init__" not in vars(kind) else ["__init__"]
    for name in [*offered(kind), *made]:
        if inspect.isfunction(function := vars(kind).get(name)):
            known = overloads(getattr(real, name))
            assert any(fits(function, each) for each in known), (name, known)


def test_a_server_that_is_not_there_is_one_line_within_the_time_out() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        with pytest.raises(SimulatorError) as error:
            open_simulator(f"carla?port={port}&timeout_s=0.3")
    assert re.fullmatch(
        rf"`simulator`: CARLA at 127.0.0.1:{port}, connecting: time-out of 300ms .*; start its server .*",
        str(error.value),
    )
