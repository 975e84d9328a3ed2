"""The control loop against virtual time, and its requests: the same ticks, numbers for what was late, and repeats."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count, pairwise
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.clock import SWITCH_S, SystemClock, VirtualClock, now_ns
from s2a_bench.errors import UsageError
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import RequestPlan, resolve
from s2a_bench.harness.session import Measured, Place, RequestContext, Session
from s2a_bench.plugins.chunks.control import Acted, ControlLoop, RobotTicks
from s2a_bench.plugins.chunks.modes import ControlSetting, Rounding, mode
from s2a_bench.plugins.chunks.modes.aggregate import Aggregate
from s2a_bench.plugins.chunks.modes.cycles import NEVER, follow
from s2a_bench.plugins.chunks.requester import ChunkRequester, Job
from s2a_bench.types import Action, Vector

PERIOD_NS, HORIZON = 1_000_000, 6
MODES = [
    "sync",
    "queue?trigger=2",
    "queue?trigger=5&execute=5",
    "replace?execute=3",
    "replace?execute=2&under_way=many",
    "replace?execute=4&assumed=2",
    "aggregate?trigger=3",
    "streamed?trigger=2&gap_s=0.0004",
    "streamed?trigger=1&gap_s=0.0017&start=naive",
]


class Late(VirtualClock):
    """A clock whose sleepers wake up late."""

    def __init__(self, late_ns: list[int]) -> None:
        super().__init__()
        self._late_ns = late_ns
        self._slept = 0

    def sleep_until_ns(self, deadline_ns: int) -> None:
        super().sleep_until_ns(deadline_ns + self._late_ns[self._slept % len(self._late_ns)])
        self._slept += 1


def act(written: str, setting: ControlSetting, latency_ns: list[int], clock: VirtualClock, ticks: int = 400) -> Acted:
    """Run a loop whose answers are delivered at once, stamped with the time at which they arrive."""
    chosen = mode(written)
    actions = [np.full(1, place, np.float32) for place in range(setting.horizon)]
    start_ns: list[int] = []

    def ask(request: int, tick: int) -> None:
        if not start_ns:
            start_ns.append(robot.acted().start_ns)
        if request < len(latency_ns):
            began_ns = start_ns[0] + tick * setting.period_ns + latency_ns[request]
            if chosen.streams:
                for place in range(setting.horizon):
                    robot.arrived(request, actions[: place + 1], began_ns + place * chosen.gap_ns)
            else:
                robot.arrived(request, actions, began_ns)

    robot = RobotTicks(chosen, setting, lambda *_: None, ask, ticks)
    ControlLoop([robot], clock).run()
    return robot.acted()


@pytest.mark.parametrize("written", MODES)
@given(
    rounding=st.sampled_from(["floor", "ceil"]),
    latency_ns=st.lists(st.integers(0, 8).map(lambda half: half * PERIOD_NS // 2), min_size=2, max_size=20),
    late_ns=st.lists(st.integers(0, 5 * PERIOD_NS), min_size=1, max_size=5),
)
def test_loop_does_what_virtual_time_says(
    written: str, rounding: Rounding, latency_ns: list[int], late_ns: list[int]
) -> None:
    setting = ControlSetting(PERIOD_NS, HORIZON, rounding)
    acted = act(written, setting, latency_ns, Late(late_ns))
    arrival_ns = np.where(acted.arrival_ns < 0, NEVER, acted.arrival_ns)
    _, expected = follow(mode(written), arrival_ns, setting, acted.chunk.size)
    assert acted.whole == len(latency_ns)
    np.testing.assert_array_equal(acted.chunk, expected.chunk)
    np.testing.assert_array_equal(acted.index, expected.index)


def test_lateness_is_told_and_made_up_for() -> None:
    acted = act("queue", ControlSetting(PERIOD_NS, HORIZON, "ceil"), [0] * 40, Late([0, 3 * PERIOD_NS]), ticks=100)
    assert acted.chunk.size == 100
    assert acted.late_ns[1] == 3 * PERIOD_NS
    assert acted.late_ns[2] == 2 * PERIOD_NS  # the clock had gone that far
    assert (acted.chunk >= 0).all()


def test_a_chunk_that_never_comes_ends_what_is_decided() -> None:
    acted = act("queue?trigger=1", ControlSetting(PERIOD_NS, HORIZON), [0, 0], VirtualClock(), ticks=50)
    assert acted.whole == 2
    assert acted.chunk.size == 50
    assert (acted.chunk[int(acted.request_tick[2]) + 1 :] < 0).all()  # one action was left


def test_robot_is_sent_each_action_and_each_stall() -> None:
    setting, sent = ControlSetting(2_000_000, 3), []
    chunk = [np.full(2, place, np.float32) for place in range(3)]
    robot = RobotTicks(
        mode("sync"),
        setting,
        lambda action, due_ns: sent.append((None if action is None else float(action[0]), due_ns)),
        lambda request, _: robot.arrived(request, chunk, now_ns() + 3_000_000),
        ticks=10,
    )
    loop = ControlLoop([robot])
    loop.start()
    assert loop.join(10)
    acted = robot.acted()
    assert len(sent) == 10
    assert [value for value, _ in sent] == [None if place < 0 else float(place) for place in acted.index]
    assert {late - early for (_, early), (_, late) in pairwise(sent)} == {2_000_000}


def test_overlapping_actions_are_blended_as_virtual_time_says() -> None:
    setting, sent = ControlSetting(PERIOD_NS, HORIZON), []
    chosen = Aggregate(3)
    rng = np.random.default_rng(0)
    chunks = rng.normal(size=(12, HORIZON, 2)).astype(np.float32)
    latency_ns = rng.integers(0, 4 * PERIOD_NS, 12)

    def ask(request: int, tick: int) -> None:
        if request < len(chunks):
            began_ns = tick * PERIOD_NS
            robot.arrived(request, list(chunks[request]), began_ns + int(latency_ns[request]))

    robot = RobotTicks(chosen, setting, lambda action, _: sent.append(action), ask, 80)
    ControlLoop([robot], VirtualClock()).run()
    cycles, ticks = follow(chosen, np.repeat(latency_ns[:, np.newaxis], HORIZON, axis=1), setting)
    expected = np.full((cycles.ticks, 2), np.nan)
    for tick, chunk, index, share in chosen.blend(cycles, ticks):
        expected[tick] = np.nan_to_num(expected[tick]) + share[:, np.newaxis] * chunks[chunk, index]
    done = np.array([[np.nan] * 2 if action is None else action for action in sent[: cycles.ticks]])
    np.testing.assert_allclose(done, expected, rtol=1e-5)


def test_failure_of_a_robot_reaches_who_waits_and_the_interpreter_is_as_before() -> None:
    before_s = sys.getswitchinterval()
    seen: list[float] = []

    def broken(*_: object) -> None:
        seen.append(sys.getswitchinterval())
        raise ValueError("the arm fell off")

    setting = ControlSetting(1_000_000, 3)
    loop = ControlLoop([RobotTicks(mode("sync"), setting, broken, lambda *_: None, 10)])
    loop.start()
    with pytest.raises(ValueError, match="fell off"):
        loop.join(10)
    assert seen == pytest.approx([SWITCH_S])
    assert sys.getswitchinterval() == before_s


def test_stop_ends_it_before_its_time() -> None:
    request_left = Event()
    setting = ControlSetting(1_000_000, 3)
    robot = RobotTicks(mode("sync"), setting, lambda *_: None, lambda *_: request_left.set(), 10**9)
    loop = ControlLoop([robot], SystemClock())
    loop.start()
    assert request_left.wait(10)
    assert not loop.join(0.001)
    loop.stop()
    assert loop.join(10)


def test_what_was_told_before_is_passed_over_and_old_chunks_are_forgotten() -> None:
    setting, sent = ControlSetting(PERIOD_NS, 3), []
    one, other = [[np.full(1, value, np.float32)] * 3 for value in (1, 2)]

    def ask(request: int, tick: int) -> None:
        for chunk in (one, other):
            robot.arrived(request, chunk, tick * PERIOD_NS)

    robot = RobotTicks(mode("replace?execute=2"), setting, lambda action, _: sent.append(action), ask, 300)
    ControlLoop([robot], VirtualClock()).run()
    assert {float(action[0]) for action in sent} == {1.0}
    assert len(robot._actions) < 3


def test_robots_of_one_loop_act_as_each_alone_does() -> None:
    setting, action = ControlSetting(PERIOD_NS, HORIZON), [np.zeros(1, np.float32)] * HORIZON
    latency_ns = [PERIOD_NS // 2, 3 * PERIOD_NS]
    phases_ns = [0, PERIOD_NS // 3]

    def robot(place: int) -> RobotTicks:
        def ask(request: int, tick: int) -> None:
            began_ns = phases_ns[place] + tick * PERIOD_NS
            made.arrived(request, action, began_ns + latency_ns[place])

        made = RobotTicks(mode("queue?trigger=2"), setting, lambda *_: None, ask, 50, phases_ns[place])
        return made

    together = [robot(place) for place in range(2)]
    ControlLoop(together, VirtualClock()).run()
    for place, each in enumerate(together):
        alone = robot(place)
        ControlLoop([alone], VirtualClock()).run()
        assert each.acted().start_ns == phases_ns[place]
        np.testing.assert_array_equal(each.acted().chunk, alone.acted().chunk)
        np.testing.assert_array_equal(each.acted().arrival_ns, alone.acted().arrival_ns)


@dataclass
class Server:
    """A session with answers of given lengths and errors."""

    answers: list[tuple[int, str]]
    """Actions, and the error."""
    places: list[Place] = field(default_factory=list)
    cell: Any = field(default_factory=lambda: SimpleNamespace(name="fake"))
    request: RequestPlan = field(default_factory=lambda: resolve(RequestsConfig(transports="loopback"), print).request)

    def measure(self, place: Place, context: RequestContext) -> Measured:
        self.places.append(place)
        actions, error = self.answers[len(self.places) - 1]
        for index in range(actions):
            context.on_piece(Action(index, np.full(1, len(self.places), np.float32)), 100 * len(self.places) + index)
        sample: Any = SimpleNamespace(error=error, request_id=f"fake-{place.block}", payload_bytes=7)
        return Measured(sample, [], 0)


def send_request(
    *answers: tuple[int, str], streams: bool = False
) -> tuple[list[tuple[list[float], int]], ChunkRequester, Server]:
    """Send one request, and return the chunks so far with their times."""
    server = Server(list(answers))
    received: list[tuple[list[float], int]] = []

    def hear(_request: int, actions: Sequence[Vector], at_ns: int) -> None:
        received.append(([float(action[0]) for action in actions], at_ns))

    requester = ChunkRequester([cast("Session", server)], 3, 0, streams, hear, count())
    with requester.running():
        requester.jobs.put(Job(0, 0, ()))
        while requester.done.qsize() < len(answers) and requester.failure is None:
            pass
    return received, requester, server


def test_a_request_that_fails_is_made_again_and_its_chunk_is_that_of_one_answer() -> None:
    received, requester, server = send_request((2, "broken"), (3, ""))
    assert received == [([2.0] * 3, 202)]
    assert [place.position for place in server.places] == [0, 1]
    assert requester.done.qsize() == 2
    assert requester.sent_bytes == 14
    assert requester.names == {0: "fake-1"}


def test_of_a_second_answer_only_actions_count_that_had_not_come() -> None:
    received, _, _ = send_request((2, "broken"), (3, ""), streams=True)
    assert received == [([1.0], 100), ([1.0] * 2, 101), ([1.0, 1.0, 2.0], 202)]


@pytest.mark.parametrize("streams", [False, True])
def test_an_answer_that_fails_once_it_is_whole_is_not_asked_for_again(streams: bool) -> None:
    received, requester, server = send_request((3, "the marks were lost"), streams=streams)
    assert received[-1] == ([1.0] * 3, 102)
    assert len(server.places) == 1
    assert requester.failure is None


def test_a_chunk_of_another_length_fails_the_loop() -> None:
    _, requester, _ = send_request((2, ""))
    assert isinstance(requester.failure, UsageError)
