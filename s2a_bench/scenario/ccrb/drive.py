"""Drive one roll-out, or M in lock step: the laws of the three cars in a simulator, until all are decided."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats, Schedule
from s2a_bench.scenario import EGO, LEAD, REAR, DriveCommand, Simulator, State
from s2a_bench.scenario.ccrb.cars import FOLLOWERS, LEAD_JERK_MPS3, LEAST_IMPACT_MPS, Cars, DrivingPlan
from s2a_bench.scenario.ccrb.ego import DONE, Ego
from s2a_bench.scenario.ccrb.follower import CarMotion, DriverView, Follower
from s2a_bench.scenario.ccrb.outcome import CollisionWatch, Outcomes
from s2a_bench.scenario.longitudinal import LockStep, Longitudinal, each

NO_LEAD_M: Final = 1e6
"""A distance at which the lead has no effect on the ego."""
AFTER_S: Final = 25.0
"""Limit of a roll-out after the end of its plan; nearly all are decided earlier."""
RECORD_S: Final = 0.01
LOOK_STEPS: Final = 40
RESTING_MPS: Final = 0.01
DROP_SHARE: Final = 0.2
"""Decided roll-outs are dropped when their share reaches this."""
PASSED_M: Final = 10.0
"""An ego this far ahead of the lead, beside it, has passed it."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Samples every `RECORD_S`: arrays of shape (steps, 3, M), phase and skill of the ego (steps, M)."""

    time_s: Floats
    position_m: Floats
    speed_mps: Floats
    lateral_m: Floats
    acceleration_mps2: Floats
    phase: NDArray[np.int64]
    skill: NDArray[np.int64]
    """The current or last skill, from 0 on; -1 before the first."""


@dataclass(frozen=True, slots=True)
class Driven:
    outcomes: Outcomes
    trajectory: Trajectory | None


def drive(
    simulator: Simulator,
    cars: Cars,
    plan: DrivingPlan,
    schedule: Schedule,
    *,
    record: bool = False,
    resting_mps: float = RESTING_MPS,
) -> Driven:
    """Drive M roll-outs and return their outcomes.

    ``schedule`` has the shape (N, M); the numbers of ``cars`` are single or of shape (M,). A roll-out ends when the
    trailing car, the last to stop, is slower than ``resting_mps``, because the careful driver never quite stops. Raises
    UsageError if the simulator has no lane changes, or too few roll-outs.
    """
    rollouts = np.broadcast_shapes(schedule.start_s.shape, (1, 1))[1]
    if any(plan.lane) and not simulator.steers:
        raise UsageError(
            f"`lane_change`: the simulator '{simulator.name}' has one lane only; take `simulator` embedded"
        )
    if simulator.most is not None and rollouts > simulator.most:
        raise UsageError(f"`simulator`: '{simulator.name}' runs {simulator.most} roll-out at a time, not {rollouts}")
    driving = Drive(simulator, cars, Ego(cars, plan, schedule, rollouts), rollouts, record=record)
    outcomes = driving.run(resting_mps=resting_mps)
    return Driven(outcomes, driving.trajectory())


def follower_survives(cars: Cars, plan: DrivingPlan, n_skills: ArrayLike, t_nom_s: ArrayLike) -> NDArray[np.bool_]:
    """Return whether the trailing car never hits an ego whose tokens arrive at once, at the same gap; shape (M,).

    The ego has no lead, and its skills run back to back at nominal durations; shorter plans end earlier.
    """
    count, nominal_s = np.broadcast_arrays(np.atleast_1d(n_skills), np.atleast_1d(np.asarray(t_nom_s, float)))
    skill = np.arange(count.max())[:, np.newaxis]
    schedule = Schedule(np.minimum(skill, count) * nominal_s, np.where(skill < count, nominal_s, 0.0))
    alone = replace(cars, front_gap_m=NO_LEAD_M, reflex=False)
    along = DrivingPlan(plan.set_point_mps, (0,) * len(plan.lane))
    code = drive(Longitudinal(), alone, along, schedule, resting_mps=LEAST_IMPACT_MPS).outcomes.code
    return np.asarray(code & 2 == 0)


def place(simulator: Simulator, cars: Cars, rollouts: int = 1) -> State:
    """Place the cars as they are at t = 0."""
    position, speed = np.zeros((3, rollouts)), np.empty((3, rollouts))
    position[LEAD], position[REAR] = cars.front_gap_m, -np.asarray(cars.rear_gap_m, float)
    speed[:] = cars.speed_mps
    return simulator.place(position, speed)


class Drive(LockStep):
    """Roll-outs in progress; `LockStep.keep` includes the laws, the delay, the watch and the simulator."""

    def __init__(self, simulator: Simulator, cars: Cars, ego: Ego, rollouts: int = 1, *, record: bool = False) -> None:
        """Place the cars; ``record`` a `trajectory` from the request on."""
        self._simulator = simulator
        self._ego = ego
        self._rear: Follower = resolve_name(FOLLOWERS[cars.follower])(cars, rollouts)
        self._lead_decel = each(cars.lead_decel_mps2, rollouts)
        self._state = state = place(simulator, cars, rollouts)
        reaction_s = np.asarray(cars.reaction_s, float)
        self._delay = Delay(state.position_m, state.speed_mps, reaction_s, simulator.step_s)
        self._acceleration = np.zeros((3, rollouts))
        self._watch = CollisionWatch(self._state)
        self._outcomes = self._watch.outcomes()
        self._left = np.arange(rollouts)
        self._seen_at_rest = np.zeros(rollouts, bool)
        self._every = max(round(RECORD_S / simulator.step_s), 1) if record else 0
        self._records: list[tuple[float, State, Floats, NDArray[np.int64], NDArray[np.int64]]] = []
        self._steps = 0

    def run(self, *, resting_mps: float) -> Outcomes:
        step_s = self._simulator.step_s
        last = int((float(self._ego.end_s.max()) + AFTER_S) / step_s)
        for step in range(last):
            self.step(step * step_s)
            if step % LOOK_STEPS == 0 and not self._go_on(self.decided(resting_mps)):
                break
        return self.outcomes()

    def step(self, now_s: float) -> None:
        """Let every driver decide, and simulate one step; before the request, at 0, no car brakes."""
        self._decide(now_s)
        if self._every and now_s >= 0:
            if self._steps % self._every == 0:
                now = (now_s, self._state, self._acceleration.copy(), self._ego.phase, self._ego.index.copy())
                self._records.append(now)
            self._steps += 1
        self._state = self._simulator.step(DriveCommand(self._acceleration, self._ego.lane))
        self._ego.stopped(self._state.speed_mps[EGO])
        self._watch.see(self._state)

    def decided(self, resting_mps: float = RESTING_MPS) -> NDArray[np.bool_]:
        speed = self._state.speed_mps
        over = self._ego.phase == DONE
        # Until the driver behind has seen the ego at rest, the rear car may stop and start again.
        calm = (speed[REAR] < resting_mps) & (self._acceleration[REAR] <= 0) & self._seen_at_rest
        behind = self._watch.rear.crashed | calm
        resting = over & (speed[EGO] <= 0) & behind
        passed = over & (self._watch.front.gap_m < -PASSED_M)
        return np.asarray(self._watch.front.crashed | resting | passed)

    @property
    def ego_moves(self) -> bool:
        return bool((self._state.speed_mps[EGO] > 0).any())

    def outcomes(self) -> Outcomes:
        self._outcomes.put(self._left, self._watch.outcomes())
        return self._outcomes

    def trajectory(self) -> Trajectory | None:
        """Return the recorded trajectory, None without a step of it."""
        if not self._records:
            return None
        times_s, states, accelerations, phases, skills = zip(*self._records, strict=True)
        return Trajectory(
            time_s=np.array(times_s),
            position_m=np.stack([state.position_m for state in states]),
            speed_mps=np.stack([state.speed_mps for state in states]),
            lateral_m=np.stack([state.lateral_m for state in states]),
            acceleration_mps2=np.stack(accelerations),
            phase=np.stack(phases),
            skill=np.stack(skills),
        )

    def _go_on(self, decided: NDArray[np.bool_]) -> bool:
        """Drop decided roll-outs, many at a time; return whether any is left."""
        share = decided.mean()
        if share == 1:
            return False
        if self._every or share < DROP_SHARE or not isinstance(self._simulator, LockStep):
            return True
        self._outcomes.put(self._left, self._watch.outcomes())
        self.keep(np.flatnonzero(~decided))
        return True

    def _decide(self, now_s: float) -> None:
        state, step_s, acceleration = self._state, self._simulator.step_s, self._acceleration
        seen = self._delay.see(state, self._ego.acceleration_mps2, acceleration[REAR])
        self._seen_at_rest = seen.ego_then.speed_mps <= 0
        lead = acceleration[LEAD]
        if now_s >= 0:
            np.maximum(lead - LEAD_JERK_MPS3 * step_s, -self._lead_decel, out=lead)
        lead_decel = np.where(state.speed_mps[LEAD] > 0, -lead, 0.0)
        gap = state.position_m[LEAD] - state.position_m[EGO]
        acceleration[EGO] = self._ego.decide(
            now_s, state.speed_mps[EGO], gap, state.speed_mps[LEAD], lead_decel, step_s
        )
        acceleration[REAR] = self._rear.acceleration(seen, step_s)


class Delay(LockStep):
    """History of ego and trailing car, with one delay per roll-out; before the start they kept their speed."""

    def __init__(self, position_m: Floats, speed_mps: Floats, delay_s: Floats, step_s: float) -> None:
        rollouts = position_m.shape[1]
        self._steps = np.broadcast_to(np.rint(delay_s / step_s).astype(np.int64), (rollouts,))
        self._same = bool((self._steps == self._steps[0]).all())
        self._size = int(self._steps.max()) + 1
        self._columns = np.arange(rollouts)
        before = np.arange(-self._size, 0)[:, np.newaxis] * step_s
        # Contiguous per roll-out: with different delays, roll-outs read different rows.
        self._past = np.zeros((self._size, rollouts, 6))
        for first, car in ((0, EGO), (3, REAR)):
            self._past[..., first] = position_m[car] + before * speed_mps[car]
            self._past[..., first + 1] = speed_mps[car]
        self._head = -1

    def keep(self, columns: NDArray[np.int64]) -> None:
        self._past = np.ascontiguousarray(self._past[:, columns])
        self._steps = self._steps[columns]
        self._columns = np.arange(len(columns))

    def see(self, state: State, ego_acceleration: Floats, rear_acceleration: Floats) -> DriverView:
        """Store the present state, and return it with the state a reaction time ago."""
        # A brake that holds a car at rest does not decelerate it.
        rear_acceleration = np.where(state.speed_mps[REAR] > 0, rear_acceleration, np.maximum(rear_acceleration, 0.0))
        ego = CarMotion(state.position_m[EGO], state.speed_mps[EGO], ego_acceleration)
        rear = CarMotion(state.position_m[REAR], state.speed_mps[REAR], rear_acceleration)
        self._head = (self._head + 1) % self._size
        now = self._past[self._head]
        for first, car in ((0, ego), (3, rear)):
            now[:, first], now[:, first + 1], now[:, first + 2] = car.position_m, car.speed_mps, car.acceleration_mps2
        if self._same:
            then = self._past[(self._head - self._steps[0]) % self._size]
        else:
            then = self._past[(self._head - self._steps) % self._size, self._columns]
        then = np.ascontiguousarray(then.T)
        return DriverView(ego, rear, CarMotion(*then[:3]), CarMotion(*then[3:]))
