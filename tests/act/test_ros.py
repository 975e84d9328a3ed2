"""Actions on a ROS 2 topic, read by a plain Cyclone DDS reader with types of its own."""

from __future__ import annotations

from dataclasses import dataclass
from types import new_class
from typing import Any

import numpy as np
import pytest

from s2a_bench.act import ActionKind, kind
from s2a_bench.act.ros import RosRobot
from s2a_bench.clock import now_ns
from s2a_bench.errors import RobotError, UsageError

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.act.ros_types import Float64MultiArray, JointTrajectory, Time

WAIT_S = 10.0


def reader(domain: int, topic: str, type_: type[Any]) -> DataReader[Any]:
    """Read a topic as ROS 2's default subscription does: reliable, XCDR1, whatever the writer says of its type.

    ROS 2's Cyclone says nothing about types besides their names. cyclonedds cannot leave that out, so the reader says
    what a type without members would, as our writers do.
    """
    nothing = new_class("Nothing", (IdlStruct,), {"typename": type_.__idl_typename__})
    for each in (type_, dataclass(nothing)):
        each.__idl__.fill_type_data()
    type_.__idl__._xt_bytedata = nothing.__idl__._xt_bytedata  # type: ignore[attr-defined]
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    participant = DomainParticipant(domain)
    return DataReader(participant, Topic(participant, f"rt{topic}", type_, qos=qos), qos=qos)


def taken(of: DataReader[Any], count: int) -> list[Any]:
    found: list[Any] = []
    deadline_ns = now_ns() + int(WAIT_S * 1e9)
    while len(found) < count:
        assert now_ns() < deadline_ns
        found += of.take(count - len(found))
    return found


def test_a_trajectory_of_one_point_is_what_a_peer_of_its_own_types_reads(dds_domain: int) -> None:
    robot = kind("ros?topic=/arm/joint_trajectory&wait_s=0", ActionKind).open_actions(2, 20_000_000)
    listener = reader(dds_domain, "/arm/joint_trajectory", JointTrajectory)
    other = kind("ros?topic=/arm/joint_trajectory", ActionKind).open_actions(2, 20_000_000)  # waits for the reader
    robot.close()
    for action in (np.array([0.25, -1.5], np.float32), None, np.array([3, 4], np.float32)):
        other.send(action, now_ns())
        if action is not None:
            (message,) = taken(listener, 1)
            assert (message.header.stamp, message.header.frame_id) == (Time(0, 0), "")
            assert message.joint_names == ["joint_1", "joint_2"]
            (point,) = message.points
            assert list(point.positions) == action.tolist()
            assert [*point.velocities, *point.accelerations, *point.effort] == []
            assert point.time_from_start == Time(0, 20_000_000)
    assert other.state() == ()
    other.close()
    other.close()


def test_an_array_has_the_action_alone(dds_domain: int) -> None:
    listener = reader(dds_domain, "/forward/commands", Float64MultiArray)
    robot = kind("ros?topic=/forward/commands&type=Float64MultiArray", ActionKind).open_actions(3, 1_500_000_000)
    robot.send(np.array([0.5, 0, -2], np.float32), now_ns())
    (message,) = taken(listener, 1)
    assert list(message.data) == [0.5, 0, -2]
    assert (list(message.layout.dim), message.layout.data_offset) == ([], 0)
    assert robot.describe()["type"] == "Float64MultiArray"
    robot.close()


def test_joints_have_the_names_that_are_given(dds_domain: int) -> None:
    listener = reader(dds_domain, "/named", JointTrajectory)
    robot = kind("ros?topic=/named&joints=lift:grip", ActionKind).open_actions(2, 1_500_000_000)
    robot.send(np.zeros(2, np.float32), now_ns())
    (message,) = taken(listener, 1)
    assert message.joint_names == ["lift", "grip"]
    assert message.points[0].time_from_start == Time(1, 500_000_000)
    facts = robot.describe()
    assert (facts["middleware"], facts["domain_id"], facts["joints"]) == ("cyclonedds", str(dds_domain), "lift:grip")
    robot.close()


def test_a_robot_that_nobody_listens_to_is_no_robot(dds_domain: int) -> None:
    with pytest.raises(RobotError, match=r"`robot`: ros: no subscription to /nowhere \(trajectory_msgs/msg/Joint"):
        kind(f"ros?topic=/nowhere&wait_s=0.2&domain_id={dds_domain}", ActionKind).open_actions(2, 20_000_000)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("ros?topic=arm", "`robot`: ros: topic = 'arm' should look like /name"),
        ("ros?namespace=arm", "`robot`: ros: namespace = 'arm' should look like /name"),
        ("ros?type=Twist", "`robot`: ros: type = 'Twist': input should be 'JointTrajectory' or 'Float64MultiArray'"),
        ("ros?joints=a:b:a", "`robot`: ros: joints = 'a:b:a' names one twice"),
        ("ros?joints=a:b&type=Float64MultiArray", "Float64MultiArray has no names of joints"),
        ("ros?middleware=opendds", "middleware = 'opendds' is not one of cyclonedds, rclpy, zenoh"),
        ("ros?domain_id=300", "`robot`: ros: domain_id = '300': input should be less than or equal to 232"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_parameter(written: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        kind(written, ActionKind)
    assert message in str(error.value)


def test_other_joints_than_the_action_has_are_refused() -> None:
    with pytest.raises(UsageError, match="`robot`: ros: joints = 'a:b' names 2 joints of 3"):
        RosRobot(joints="a:b").open_actions(3, 1)


def test_what_is_about_skills_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^`robot`: ros: namespace is about skills, not actions$"):
        kind("ros?namespace=/arm", ActionKind).open_actions(3, 1)
