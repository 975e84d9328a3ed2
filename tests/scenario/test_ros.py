"""The ego commanded and seen over ROS 2."""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cache
from typing import Any

import highway_env  # noqa: F401 - its import sets a variable of the environment
import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from s2a_bench.errors import SourceError, TransportError, UsageError
from s2a_bench.policy import Plans, Policy
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.nominal import Clairvoyant, WaitThenAct
from s2a_bench.policy.parameters import build
from s2a_bench.ros import messages as ros
from s2a_bench.ros import open_middleware
from s2a_bench.scenario import LEAD, Simulator
from s2a_bench.scenario.ccrb.cars import Cars, braking_plan
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.embedded import Embedded
from s2a_bench.scenario.ros import EgoParameters, RosEgo, message
from s2a_bench.testing.simulator import SPEED, START, SimulatorSuite, command
from tests.scenario.carla_stand_in import CONTROL, NATIVE, PLAIN, STAMPED, RosWorld
from tests.suites import once

SPOKEN = {
    "": (CONTROL, *NATIVE),
    "&message=ackermann": (STAMPED, "/carla/ego/ackermann_control_cmd", "/carla/ego/front/image"),
    "&preset=bridge": (CONTROL, "/carla/ego_vehicle/vehicle_control_cmd", "/carla/ego_vehicle/rgb_front/image"),
    "&preset=bridge&message=ackermann": (
        PLAIN,
        "/carla/ego_vehicle/ackermann_cmd",
        "/carla/ego_vehicle/rgb_front/image",
    ),
    "&command=/car/go&picture=/car/eye": (CONTROL, "/car/go", "/car/eye"),
}
"""Parameters -> type and topic of the commands, topic of the pictures."""
DEFINITIONS = {
    CONTROL: "std_msgs/Header header\nfloat32 throttle\nfloat32 steer\nfloat32 brake\nbool hand_brake\nbool reverse\n"
    "int32 gear\nbool manual_gear_shift\n",
    PLAIN: "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\n"
    "float32 jerk\n",
    STAMPED: "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}
"""As in the packages carla_msgs and ackermann_msgs."""


@dataclass
class Meeting:
    """Where the ego and its world meet over one middleware."""

    stack: ExitStack
    middleware: str
    place: str

    def world(self, type_name: str = CONTROL, *topics: str, **more: Any) -> RosWorld:
        node = open_middleware(self.middleware, node_name="/carla", place=self.place)
        return RosWorld(node, type_name, *(topics or NATIVE), **more)

    def parameters(self, more: str = "", wait_s: float = 20) -> EgoParameters:
        router = f"&router={self.place}" * bool(self.place)
        return build(EgoParameters, f"ros?middleware={self.middleware}{router}&wait_s={wait_s}{more}", "ego")

    def ego(self, world: Simulator, more: str = "", wait_s: float = 20) -> RosEgo:
        return self.stack.enter_context(closing(RosEgo(world, self.parameters(more, wait_s))))


@pytest.fixture
def meeting(from_pypi: str, place: str, stack: ExitStack) -> Meeting:
    """Each middleware that comes from PyPI; where nodes meet at a place, one more is that, as worlds come and go."""
    if place:
        host = open_middleware(from_pypi, node_name="/router", place=place, host=True)
        stack.enter_context(closing(host))
    return Meeting(stack, from_pypi, place)


def driven(world: Simulator, policy: Policy) -> Driven:
    cars, nominal = Cars(), np.full((5, 1), 0.8)
    plans = Plans(uniform(0.5, 6, 4.8, 5), nominal, 0.8 * nominal, 1.5 * nominal)
    return drive(world, cars, braking_plan(cars, 5, 0.8), policy.schedule(plans), record=True)


@cache
def direct(policy: Policy) -> Driven:
    return driven(Embedded(), policy)


@once
class TestContract(SimulatorSuite):
    """What a simulator keeps, driven and seen over ROS."""

    name = "embedded"

    test_it_is_registered_under_its_name = None  # type: ignore[assignment]  # it has the name of the wrapped world

    @pytest.fixture
    def world(self, meeting: Meeting) -> Simulator:
        return meeting.ego(meeting.world())


@pytest.mark.parametrize(
    ("more", "policy"), [("", Clairvoyant()), ("&message=ackermann", WaitThenAct())], ids=["stream", "wait"]
)
def test_a_drive_over_ros_is_the_direct_one_but_for_single_precision_and_the_held_brake(
    meeting: Meeting, more: str, policy: Policy
) -> None:
    """Commands travel as float32; below 0.1 m/s an ego that is to stop is held by the full brake."""
    found, wanted = driven(meeting.ego(meeting.world(*SPOKEN[more]), more), policy), direct(policy)
    assert found.outcomes.name(0) == wanted.outcomes.name(0)
    for name in ("min_front_gap_m", "min_rear_gap_m", "impact_speed_mps"):
        assert getattr(found.outcomes, name) == pytest.approx(getattr(wanted.outcomes, name), abs=0.005, nan_ok=True)
    steps = min(len(each.trajectory.time_s) for each in (found, wanted))
    for name, most in (("position_m", 0.005), ("speed_mps", 0.1)):
        over_ros, directly = (getattr(each.trajectory, name)[:steps] for each in (found, wanted))
        assert np.abs(over_ros - directly).max() < most


@once
@pytest.mark.parametrize("more", SPOKEN)
def test_each_preset_speaks_and_looks_under_the_names_of_its_own(meeting: Meeting, more: str) -> None:
    type_name, commands, pictures = SPOKEN[more]
    world = meeting.world(type_name, commands, pictures)
    ego = meeting.ego(world, more)
    camera = ego.camera(64, 48)
    assert camera.name.partition("?")[0] == f"ros:{pictures}"
    assert camera.encoding == "bgr8"
    ego.place(START, SPEED)
    ego.step(command(ego=-2.0))
    assert world.received[-1].__msgtype__ == type_name
    if type_name != CONTROL:
        drive_ = getattr(world.received[-1], "drive", world.received[-1])
        assert (drive_.acceleration, drive_.speed, drive_.steering_angle) == (-2.0, pytest.approx(8.0), 0.0)


@once
def test_all_but_the_commands_is_the_wrapped_world(meeting: Meeting) -> None:
    world = meeting.world()
    ego = meeting.ego(world)
    for name in ("name", "real", "steers", "most", "over_ros", "step_s"):
        assert getattr(ego, name) == getattr(world, name)
    ego.step_s = 0.02  # as a run may choose it
    ego.place(START, SPEED)
    assert ego.step(command()).position_m[:, 0] == pytest.approx(START[:, 0] + 0.2)
    ego.close()
    assert world.closed == 1


@once
def test_pictures_are_of_the_cars_as_they_were_placed_and_as_they_drive_on(meeting: Meeting) -> None:
    ego = meeting.ego(meeting.world())
    camera = ego.camera(160, 120)
    near = np.array([[12.0], [0.0], [-14.0]])
    wanted = Embedded()
    eye = wanted.camera(160, 120)
    for position in (START, near):
        state = ego.place(position, SPEED)
        assert (state.position_m, state.speed_mps) == (pytest.approx(position), pytest.approx(SPEED))
        wanted.place(position, SPEED)
        apart = np.abs(camera.read().data.astype(int) - eye.read().data)
        assert np.mean(apart > 24) < 0.02  # the dashes of the lane are where they are some steps later
    before = camera.read()
    again = camera.read()
    assert again.stamp_ns == before.stamp_ns  # nothing was stepped
    assert again.index == before.index + 1
    np.testing.assert_array_equal(again.data, before.data)
    for _ in range(100):
        ego.step(command(lead=-6.0))
    assert np.any(camera.read().data != before.data)


def test_a_command_that_nobody_takes_is_one_line(meeting: Meeting) -> None:
    ego = meeting.ego(meeting.world(), "&command=/carla/hero/vehicle_control_cmd", wait_s=0.3)
    with pytest.raises(TransportError) as error:
        ego.place(START, SPEED)
    (line,) = str(error.value).splitlines()
    assert line.startswith(
        f"`ego`: ros: no subscriber of /carla/hero/vehicle_control_cmd ({CONTROL}) appeared in 0.3 s; start CARLA with"
    )
    assert line.endswith("command, domain_id or middleware (?preset=bridge)")


@once
def test_a_picture_that_never_comes_is_one_line(meeting: Meeting) -> None:
    ego = meeting.ego(meeting.world(), "&picture=/carla/hero/front/image", wait_s=1)
    with pytest.raises(SourceError) as error:
        ego.camera(64, 48)
    (line,) = str(error.value).splitlines()
    assert line.startswith("`ego`: ros:/carla/hero/front/image?")
    assert "has no publisher after 1 s; topics of pictures here: /carla/ego/front/image." in line
    assert "of the ego)" in line


@once
def test_a_world_that_stops_showing_pictures_is_one_line(meeting: Meeting) -> None:
    world = meeting.world()
    ego = meeting.ego(world, wait_s=1)
    ego.camera(64, 48)
    world.blind = True
    with pytest.raises(SourceError, match=r"^`ego`: ros:/carla/ego/front/image.*: no picture for 1 s of 1 publisher"):
        ego.place(START, SPEED)


@once
def test_a_closed_camera_leaves_the_world_alone(meeting: Meeting) -> None:
    world = meeting.world()
    ego = meeting.ego(world, wait_s=1)
    ego.camera(64, 48).close()
    world.blind = True
    ego.place(START, SPEED)
    assert ego.step(command()).position_m[LEAD, 0] == pytest.approx(40.05)


@once
def test_a_world_that_breaks_while_the_camera_opens_says_so(meeting: Meeting) -> None:
    world = meeting.world()
    world.breaks = TransportError("the server has left")
    with pytest.raises(TransportError, match=r"^the server has left$"):
        meeting.ego(world, wait_s=0.5).camera(64, 48)


@pytest.mark.parametrize(
    ("written", "says"),
    [
        ("ros?preset=autoware", "preset = 'autoware': input should be 'native' or 'bridge'"),
        ("ros?message=twist", "message = 'twist': input should be 'control' or 'ackermann'"),
        ("ros?command=go", "command = 'go': string should match pattern '^(/"),
        ("ros?picture=/a b", "picture = '/a b': string should match pattern '^(/"),
        ("ros?middleware=opendds", "middleware = 'opendds' is not one of cyclonedds, rclpy, zenoh"),
        ("ros?wait_s=0", "wait_s = '0'"),
        ("ros?topic=/a", "'topic' is not a parameter; its parameters are middleware, domain_id, router, wait_s"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_parameter(written: str, says: str) -> None:
    with pytest.raises(UsageError, match=r"^`ego`: ros: ") as error:
        build(EgoParameters, written, "ego")
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("acceleration", "speed", "throttle", "brake"),
    [
        (0.0, 0.0, 0.0, 1.0),
        (-2.0, 0.05, 0.0, 1.0),
        (0.5, 0.0, 0.15, 0.0),
        (0.0, 20.0, 0.055, 0.0),
        (-8.0, 10.0, 0.0, 7.87 / 9),
        (-0.1, 10.0, 0.0075, 0.0),
        (9.0, 10.0, 1.0, 0.0),
        (-20.0, 10.0, 0.0, 1.0),
    ],
)
def test_pedals_are_of_a_car_of_4_and_9_mps2_that_rolls_against_the_air(
    acceleration: float, speed: float, throttle: float, brake: float
) -> None:
    control = message(CONTROL, acceleration, speed)
    assert (control.throttle, control.brake) == pytest.approx((throttle, brake))


@pytest.mark.parametrize(
    ("acceleration", "speed", "target"),
    [(0.0, 14.0, 14.0), (-6.0, 14.0, 8.0), (-6.0, 3.0, 0.1), (-1.0, 0.05, 0.0), (0.0, 0.0, 0.0), (2.0, 0.0, 2.0)],
)
def test_an_ackermann_speed_is_a_second_ahead_and_zero_at_rest_alone(
    acceleration: float, speed: float, target: float
) -> None:
    drive_ = message(PLAIN, acceleration, speed)
    assert (drive_.speed, drive_.acceleration) == (pytest.approx(target), acceleration)


@pytest.mark.parametrize("type_name", [CONTROL, STAMPED, PLAIN])
def test_messages_are_byte_for_byte_what_rosbags_makes_of_the_packages_own_definitions(
    type_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000_123_456_789)
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    of = store.types
    stamp = of["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=123_456_789)
    header = of["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    whole = dict.fromkeys(("steering_angle", "steering_angle_velocity", "jerk"), 0.0)
    if type_name == CONTROL:
        straight: dict[str, Any] = {"steer": 0.0, "gear": 0}
        straight |= dict.fromkeys(("hand_brake", "reverse", "manual_gear_shift"), False)
        wanted = of[CONTROL](header=header, throttle=0.0, brake=(3.5 - 0.1 - 0.03) / 9, **straight)
    else:
        wanted = of[PLAIN](speed=6.5, acceleration=-3.5, **whole)
        wanted = wanted if type_name == PLAIN else of[STAMPED](header=header, drive=wanted)
    expected = bytes(store.serialize_cdr(wanted, type_name))
    made = bytes(ros.serialise(message(type_name, -3.5, 10.0), type_name, padded=False))
    assert made[:1] + made[4:] == expected[:1] + expected[4:]
    assert len(made) == len(expected)
    assert ros.type_hash(type_name) == store.hash_rihs01(type_name)
