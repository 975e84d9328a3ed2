"""The scenario as OpenSCENARIO 1.0 files with an OpenDRIVE road, for ScenarioRunner, esmini and others.

One file a policy, as the ego's skills start when the policy starts them. What the standard cannot say is left out or
said more coarsely: the ego follows its set-points exactly, and the trailing car keeps its distance with bounded braking
once it has had time to react; its careful law is ours alone. The files are checked against the standard's own schema,
which the package scenariogeneration brings (extra ``scenario``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.policy import Schedule
from s2a_bench.scenario.ccrb.cars import EGO_LEAST_MPS2, LEAD_JERK_MPS3, Cars, DrivingPlan
from s2a_bench.scenario.ccrb.follower import MOST_MPS2
from s2a_bench.scenario.ccrb.options import CcrbOptions

if TYPE_CHECKING:
    from s2a_bench.plan.skillset import Gap

MINOR: Final = 0
"""ScenarioRunner reads 1.0; newer readers read it too."""
SCHEMA: Final = "OpenSCENARIO_1_0.xsd"
ROAD_M: Final = 2000.0
START_M: Final = 200.0
LENGTH_M, WIDTH_M = 5.0, 2.0
LANES: Final = {0: "-2", 1: "-1"}
"""Right-hand traffic: lanes to the right of the middle have negative numbers, the outer one the larger."""
AFTER_S: Final = 20.0


def write_openscenario(path: Path, asked: CcrbOptions, schedules: Mapping[str, Schedule]) -> list[Path]:
    """Write ``PATH`` as one file a policy, STEM-POLICY.xosc, and STEM.xodr; return what was written.

    Takes the first roll-out. Raises UsageError for a path that cannot be written, MissingExtra without the package.
    """
    if path.suffix != ".xosc":
        raise UsageError(f"`openscenario`: {path} should end in .xosc")
    xodr = extras.require("scenariogeneration", "scenario").xodr
    road = path.with_suffix(".xodr")
    drive = xodr.OpenDrive(path.stem)
    drive.add_road(xodr.create_road(xodr.Line(ROAD_M), 0, left_lanes=0, right_lanes=2, lane_width=4))
    drive.adjust_roads_and_lanes()
    written = [road]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        drive.write_xml(str(road))
        for name, schedule in schedules.items():
            file = path.with_name(f"{path.stem}-{name}.xosc")
            _scenario(name, asked.cars, asked.driving, schedule, road.name).write_xml(str(file))
            written.append(file)
    except OSError as error:
        raise UsageError(f"`openscenario`: cannot write {path}: {error.strerror}") from error
    return written


def problems(path: Path) -> list[str]:
    """Check a file against the standard's schema; return what is wrong with it, nothing where all is well."""
    xmlschema = extras.require("xmlschema", "scenario")
    schemas = extras.require("schemas", "scenario")
    schema = xmlschema.XMLSchema(str(Path(schemas.__path__[0]) / SCHEMA))
    return [str(error.reason) for error in schema.iter_errors(str(path))]


def _scenario(name: str, cars: Cars, plan: DrivingPlan, schedule: Schedule, road: str) -> Any:
    """Put the parts of one file together."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    entities = xosc.Entities()
    init = xosc.Init()
    speed = float(np.asarray(cars.speed_mps))
    places = {
        "lead": float(np.asarray(cars.front_gap_m)) + LENGTH_M,
        "ego": 0.0,
        "rear": -float(np.asarray(cars.rear_gap_m)) - LENGTH_M,
    }
    for car, ahead_m in places.items():
        entities.add_scenario_object(car, _vehicle(car))
        init.add_init_action(car, xosc.TeleportAction(xosc.LanePosition(START_M + ahead_m, 0, LANES[0], "0")))
        init.add_init_action(car, _speed(speed))
    end_s = float(schedule.start_s[-1, 0] + schedule.duration_s[-1, 0])
    board = xosc.StoryBoard(init, _at("stop", end_s + AFTER_S, "stop"))
    act = xosc.Act("drive", _at("begin", 0.0))
    lead = float(np.asarray(cars.lead_decel_mps2))
    # A braking that builds up evenly comes to the same as one that jumps half of that time later.
    act.add_maneuver_group(_group("lead", [("brake", lead / LEAD_JERK_MPS3 / 2, _speed(0.0, rate=lead))]))
    act.add_maneuver_group(_group("ego", list(_ego_actions(cars, plan, schedule))))
    distance = float(np.asarray(cars.rear_gap_m))
    follow = xosc.LongitudinalDistanceAction(
        "ego", max_acceleration=2, max_deceleration=MOST_MPS2, max_speed=speed, distance=distance
    )
    act.add_maneuver_group(_group("rear", [("follow", float(np.asarray(cars.reaction_s)), follow)]))
    board.add_act(act)
    return xosc.Scenario(
        f"CCRB with a car behind, {name}",
        "s2a-bench",
        xosc.ParameterDeclarations(),
        entities,
        board,
        xosc.RoadNetwork(road),
        xosc.Catalog(),
        osc_minor_version=MINOR,
    )


def _ego_actions(cars: Cars, plan: DrivingPlan, schedule: Schedule) -> Iterator[tuple[str, float, Any]]:
    """List what the ego does and when: its skills, and the gap behaviour between them."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    start, duration = schedule.start_s[:, 0], np.broadcast_to(schedule.duration_s, schedule.start_s.shape)[:, 0]
    for index, lane in enumerate(plan.lane):
        before, target = (float(plan.set_point_mps[index + place, 0]) for place in (0, 1))
        if lane:
            dynamics = xosc.TransitionDynamics(
                xosc.DynamicsShapes.sinusoidal, xosc.DynamicsDimension.time, float(duration[index])
            )
            action: Any = xosc.AbsoluteLaneChangeAction(int(LANES[lane]), dynamics)
        else:
            action = _speed(target, time=float(duration[index]))
        yield f"skill-{index + 1}", float(start[index]), action
        end = float(start[index] + duration[index])
        last = index == len(plan.lane) - 1
        if not last and float(start[index + 1]) - end > 1e-6:  # noqa: PLR2004 - rounding
            slope = (before - target) / float(duration[index])
            if (between := _between(str(cars.gap), slope, float(np.asarray(cars.speed_mps)))) is not None:  # type: ignore[arg-type]
                yield f"gap-{index + 1}", end, between


def _between(gap: Gap, decel: float, first: float) -> Any:
    """Return the action for a gap; None where the speed is kept, as after every speed action."""
    rules: dict[Gap, Any] = {
        "stop": lambda: _speed(0.0, rate=-EGO_LEAST_MPS2),
        "coast": lambda: None,
        "hold": lambda: _speed(0.0, rate=decel) if decel > 0 else None,
        "cruise": lambda: _speed(first, rate=2.0),
    }
    return rules[gap]()


def _speed(target: float, *, rate: float | None = None, time: float | None = None) -> Any:
    """Return a speed action: at once, at a rate in m/s^2, or within a time in s."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    if rate is not None:
        dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.linear, xosc.DynamicsDimension.rate, rate)
    elif time is not None:
        dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.linear, xosc.DynamicsDimension.time, time)
    else:
        dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    return xosc.AbsoluteSpeedAction(target, dynamics)


def _group(car: str, actions: list[tuple[str, float, Any]]) -> Any:
    """Return a car's maneuver: each action at its time, the newest one wins."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    maneuver = xosc.Maneuver(f"{car}-maneuver")
    for name, at_s, action in actions:
        event = xosc.Event(f"{car}-{name}", xosc.Priority.overwrite)
        event.add_trigger(_at(f"{car}-{name}-begins", at_s))
        event.add_action(f"{car}-{name}-action", action)
        maneuver.add_event(event)
    group = xosc.ManeuverGroup(f"{car}-group")
    group.add_actor(car)
    group.add_maneuver(maneuver)
    return group


def _at(name: str, at_s: float, kind: str = "start") -> Any:
    """Return a trigger by simulation time."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    condition = xosc.SimulationTimeCondition(at_s, xosc.Rule.greaterThan)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, triggeringpoint=kind)


def _vehicle(name: str) -> Any:
    """Return a car whose middle is its origin."""
    xosc = extras.require("scenariogeneration", "scenario").xosc
    box = xosc.BoundingBox(WIDTH_M, LENGTH_M, 1.5, 0, 0, 0.75)
    front, rear = xosc.Axle(0.5, 0.8, 1.7, 1.4, 0.4), xosc.Axle(0, 0.8, 1.7, -1.4, 0.4)
    return xosc.Vehicle(name, xosc.VehicleCategory.car, box, front, rear, 70, 10, 10)
