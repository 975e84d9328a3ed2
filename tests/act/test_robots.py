"""Skills on the system clock: functions and ROS 2 actions."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from threading import Event as Flag
from threading import Thread
from types import SimpleNamespace

import pytest

from s2a_bench.act import SkillKind, SkillRobot, kind, ros
from s2a_bench.act.call import CallableRobot, SkillFunction, SkillMotion
from s2a_bench.act.events import AbortRequested, LiveInbox, Requested, SkillArrived, StreamEnded
from s2a_bench.act.executor import Executor
from s2a_bench.act.record import Record
from s2a_bench.act.ros import EXECUTE_SKILL, RosSkills
from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.plan import Call, load_skills, parse_skills
from s2a_bench.policy import PlanShape, Timing, policy
from s2a_bench.ros import ActionServer, Middleware, ServerGoal, open_middleware
from s2a_bench.ros.messages import default

QUICK = parse_skills(
    """
name = "quick"
role = "test"
gap = "stop"
[vocabulary]
thing = ["cup", "box"]
[[skill]]
name = "wave"
arguments = ["thing"]
t_min_s = 0.02
t_nom_s = 0.04
t_max_s = 0.06
gap = "coast"
""",
    "quick",
)
CUP, BOX = QUICK.calls
NS = 1_000_000


def execute(robot: SkillRobot, calls: list[Call], *, patience_s: float = 10.0, abort_at: Flag | None = None) -> Record:
    """Run calls that have all arrived, on the system clock."""
    inbox = LiveInbox()
    known = PlanShape(len(calls), 1, Timing(0.04, 0.02, 0.06))
    executor = Executor(policy("naive"), known, robot, inbox, SystemClock(), gap=QUICK.gap, patience_s=patience_s)
    start_ns = now_ns()
    for event in (Requested(start_ns), *(SkillArrived(start_ns, call) for call in calls), StreamEnded(start_ns)):
        inbox.put(event)
    if abort_at is not None:
        Thread(target=lambda: (abort_at.wait(10), inbox.put(AbortRequested(now_ns()))), daemon=True).start()
    return executor.run()


class TestFunctions:
    def test_each_call_is_made_with_its_arguments_in_order(self) -> None:
        seen: list[object] = []

        def wave(motion: SkillMotion) -> None:
            seen.append(motion.arguments["thing"])
            assert motion.wait()

        record = execute(CallableRobot(QUICK, {"wave": wave}, seen.append), [CUP, BOX, CUP])
        assert record.outcome == "completed"
        assert seen == ["stop", "cup", "box", "cup", "coast"]
        for run in record.skills:
            assert run.end_ns is not None
            assert run.end_ns >= run.until_ns == run.ordered_ns + 40 * NS
            assert run.due_ns <= run.ordered_ns <= run.start_ns

    def test_a_function_that_raises_fails_the_plan(self) -> None:
        def wave(motion: SkillMotion) -> None:
            raise RuntimeError(f"no grip on the {motion.arguments['thing']}")

        record = execute(CallableRobot(QUICK, {"wave": wave}), [CUP, BOX])
        assert (record.outcome, len(record.skills)) == ("skill-failed", 1)
        assert record.why == "wave(cup): RuntimeError: no grip on the cup"

    def test_a_function_that_takes_longer_is_waited_for(self) -> None:
        clock = SystemClock()
        record = execute(CallableRobot(QUICK, {"wave": lambda _: clock.sleep_until_ns(now_ns() + 90 * NS)}), [CUP, BOX])
        assert record.outcome == "completed"
        first, second = record.skills
        assert first.end_ns is not None
        assert first.end_ns - first.ordered_ns >= 90 * NS
        assert second.start_ns >= first.end_ns

    def test_a_function_that_does_not_end_is_told_to_and_given_up(self) -> None:
        delivered = Flag()

        def wave(motion: SkillMotion) -> None:
            while motion.wait():
                pass
            delivered.set()

        record = execute(CallableRobot(QUICK, {"wave": wave}), [CUP], patience_s=0.05)
        assert record.outcome == "skill-overran"
        assert delivered.wait(10)

    def test_an_abort_reaches_the_function(self) -> None:
        begun, stopped = Flag(), Flag()

        def wave(motion: SkillMotion) -> None:
            begun.set()
            motion.retime(now_ns() + 3600 * 10**9)
            assert not motion.wait()
            assert motion.aborted
            stopped.set()

        record = execute(CallableRobot(QUICK, {"wave": wave}), [CUP, BOX], abort_at=begun)
        assert (record.outcome, len(record.skills)) == ("aborted", 1)
        assert stopped.wait(10)

    def test_waiting_follows_a_moved_end(self) -> None:
        motion = SkillMotion(CUP, now_ns() + 3600 * 10**9)
        assert motion.remaining_s > 3000
        Thread(target=motion.retime, args=(now_ns(),)).start()
        assert motion.wait()
        assert motion.remaining_s == 0

    def test_a_skill_without_a_function_is_refused(self) -> None:
        actions: dict[str, SkillFunction] = {"go_to": lambda _: None, "pick": lambda _: None}
        with pytest.raises(UsageError, match="`robot`: no function for the skills open, close, place of 'household'"):
            CallableRobot(load_skills("household"), actions)


class TestRosActions:
    pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")

    @pytest.fixture
    def serving(self, dds_domain: int, stack: ExitStack) -> Middleware:
        middleware = open_middleware("cyclonedds", domain_id=dds_domain)
        stack.callback(middleware.close)
        return middleware

    @pytest.fixture
    def server(self, serving: Middleware) -> ActionServer:
        return serving.action_server("/arm/execute_skill", EXECUTE_SKILL)

    @pytest.fixture
    def robot(self, dds_domain: int, stack: ExitStack, server: ActionServer) -> RosSkills:
        del server
        robot = RosSkills(open_middleware("cyclonedds", domain_id=dds_domain), "/arm", 10.0)
        stack.callback(robot.close)
        return robot

    def serve(
        self, server: ActionServer, goals: int, answer: str = "succeed", begun: Flag | None = None
    ) -> list[tuple[str, list[str], float]]:
        """Answer goals on a thread, and return what they ask for as it comes."""
        goals_received: list[tuple[str, list[str], float]] = []
        self.cancelled = Flag()

        def end(goal: ServerGoal) -> None:
            if answer == "reject":
                goal.reject()
                return
            goal.accept()
            assert goal.executing()
            success = answer == "succeed"
            quiet = success or answer.startswith("mute")
            result = default(EXECUTE_SKILL + "_Result", success=success, message="" if quiet else "jammed")
            if answer == "cancel":
                assert begun is not None
                begun.set()
                while not goal.cancel_requested:
                    server.next_goal(0.01)
                goal.canceled(result)
                self.cancelled.set()
            elif answer.endswith("abort"):
                goal.abort(result)
            else:
                goal.succeed(result)

        def run() -> None:
            while len(goals_received) < goals:
                goal = server.next_goal(0.1)
                if goal is not None:
                    wanted = goal.unpack()
                    goals_received.append((wanted.skill, list(wanted.arguments), wanted.duration))
                    end(goal)

        Thread(target=run, daemon=True).start()
        return goals_received

    def test_every_skill_is_a_goal_and_ends_with_its_result(self, server: ActionServer, robot: RosSkills) -> None:
        goals_received = self.serve(server, 2)
        record = execute(robot, [CUP, BOX])
        assert (record.outcome, len(record.ran)) == ("completed", 2)
        assert [(skill, arguments) for skill, arguments, _ in goals_received] == [("wave", ["cup"]), ("wave", ["box"])]
        assert all(0 <= duration_s <= 0.04 for _, _, duration_s in goals_received)

    @pytest.mark.parametrize(("left_s", "least_s", "most_s"), [(3600.0, 3000.0, 3600.0), (-1.0, 0.0, 0.0)])
    def test_a_goal_is_told_the_time_that_is_left_and_the_skill_s_bounds(
        self, server: ActionServer, robot: RosSkills, left_s: float, least_s: float, most_s: float
    ) -> None:
        running = robot.start(CUP, now_ns() + round(left_s * 1e9), lambda _: None)
        assert not running.ended()  # its result will say so
        deadline_ns = now_ns() + 10 * 10**9
        while (goal := server.next_goal(0.1)) is None:
            assert now_ns() < deadline_ns
        wanted = goal.unpack()
        assert least_s <= wanted.duration <= most_s
        assert (wanted.duration_least, wanted.duration_most) == (pytest.approx(0.02), pytest.approx(0.06))

    @pytest.mark.parametrize(
        ("answer", "why"),
        [
            ("abort", "wave(cup): the goal ended ABORTED: jammed"),
            ("reject", "wave(cup): the robot rejected the goal"),
            ("fail", "wave(cup): jammed"),
            ("mute abort", "wave(cup): the goal ended ABORTED"),
            ("mute", "wave(cup): the robot reports no success"),
        ],
    )
    def test_a_goal_that_goes_wrong_fails_the_plan(
        self, server: ActionServer, robot: RosSkills, answer: str, why: str
    ) -> None:
        self.serve(server, 1, answer)
        record = execute(robot, [CUP, BOX])
        assert (record.outcome, record.why, len(record.skills)) == ("skill-failed", why, 1)

    @pytest.mark.parametrize(("answer", "why"), [("succeed", "no type"), ("abort", "the goal ended ABORTED")])
    def test_a_result_that_cannot_be_read_fails_the_plan(
        self, server: ActionServer, robot: RosSkills, monkeypatch: pytest.MonkeyPatch, answer: str, why: str
    ) -> None:
        def refuse(_: object) -> None:
            raise TransportError("no type")

        monkeypatch.setattr(robot._client, "unpack_result", refuse)
        self.serve(server, 1, answer)
        record = execute(robot, [CUP])
        assert (record.outcome, record.why) == ("skill-failed", f"wave(cup): {why}")

    def test_an_abort_cancels_the_goal(self, server: ActionServer, robot: RosSkills) -> None:
        begun = Flag()
        goals_received = self.serve(server, 1, "cancel", begun)
        record = execute(robot, [CUP], abort_at=begun)
        assert (record.outcome, [skill for skill, _, _ in goals_received]) == ("aborted", ["wave"])
        assert self.cancelled.wait(10)

    def test_gaps_are_published(self, serving: Middleware, server: ActionServer, robot: RosSkills) -> None:
        from s2a_bench.ros import QoS

        listener = serving.subscription("/arm/gap", "std_msgs/msg/String", QoS())
        deadline = now_ns() + 10 * 10**9
        while not listener.matched() and now_ns() < deadline:
            listener.take(0.01)
        self.serve(server, 1)
        execute(robot, [CUP])
        heard = []
        while (packed := listener.take(0.5)) is not None:
            heard.append(listener.unpack(packed).data)
        assert heard[-1] == "coast"

    def test_who_listens_keeps_no_process_alive_and_ends_when_closed(self, robot: RosSkills) -> None:
        (listener,) = [thread for thread in threading.enumerate() if thread.name == "skills"]
        assert listener.daemon
        robot.close()
        assert not listener.is_alive()
        robot.close()

    def test_whoever_finds_no_robot_leaves_the_domain(self, monkeypatch: pytest.MonkeyPatch) -> None:
        left: list[bool] = []
        middleware = SimpleNamespace(close=lambda: left.append(True))

        def interrupted(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("s2a_bench.ros.join.open_middleware", lambda *_, **__: middleware)
        monkeypatch.setattr(ros, "RosSkills", interrupted)
        with pytest.raises(KeyboardInterrupt):
            kind("ros", SkillKind).open_skills(QUICK)
        assert left == [True]

    def test_its_parameters_name_the_node_and_the_domain(self, dds_domain: int, stack: ExitStack) -> None:
        written = f"ros?namespace=/left/arm&middleware=cyclonedds&domain_id={dds_domain}&wait_s=0.2"
        with pytest.raises(TransportError, match=r"no server of the action /left/arm/execute_skill .* in 0\.2 s"):
            kind(written, SkillKind).open_skills(QUICK)
        middleware = open_middleware("cyclonedds", domain_id=dds_domain)
        stack.callback(middleware.close)
        self.serve(middleware.action_server("/left/arm/execute_skill", EXECUTE_SKILL), 1)
        robot = kind(written.replace("0.2", "10"), SkillKind).open_skills(QUICK)
        stack.callback(robot.close)
        assert execute(robot, [CUP]).outcome == "completed"

    @pytest.mark.parametrize("parameter", ["topic=/arm", "type=Float64MultiArray", "joints=a:b"])
    def test_what_is_about_actions_is_refused(self, parameter: str) -> None:
        name = parameter.partition("=")[0]
        with pytest.raises(UsageError, match=f"^`robot`: ros: {name} is about actions, not skills$"):
            kind(f"ros?{parameter}", SkillKind).open_skills(QUICK)
