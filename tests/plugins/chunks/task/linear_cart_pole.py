"""The linearised cart-pole as an environment, its LQR as a policy, and when that is stable under delay."""

from __future__ import annotations

from functools import cache
from itertools import count
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.wrappers import DelayObservation
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, solve_discrete_are

HERE: Final = "tests.plugins.chunks.task.linear_cart_pole"
POLICY: Final = f"call?function={HERE}:lqr"
WEIGHTS: Final = {"quick": ((1, 1, 10, 1), 1), "calm": ((1, 1, 1, 1), 10)}
"""Q's diagonal, and R."""
GRAVITY, CART, POLE, HALF = 9.8, 1.0, 0.1, 0.5
Floats = NDArray[np.float64]


def held(seconds: float) -> tuple[Floats, Floats]:
    """Return A and B of x' = A x + B u for a step of that length, u held: CartPole-v1's equations about upright."""
    lever = HALF * (4 / 3 - POLE / (CART + POLE))
    a, b = GRAVITY / lever, -1 / ((CART + POLE) * lever)
    ratio = POLE * HALF / (CART + POLE)
    drift = [[0, 1, 0, 0], [0, 0, -ratio * a, 0], [0, 0, 0, 1], [0, 0, a, 0]]
    push = [[0], [1 / (CART + POLE) - ratio * b], [0], [b]]
    both = expm(np.block([[np.array(drift), np.array(push)], [np.zeros((1, 5))]]) * seconds)
    return both[:4, :4], both[:4, 4:]


@cache
def gain(name: str, period_s: float) -> Floats:
    a, b = held(period_s)
    states, force = WEIGHTS[name]
    cost = solve_discrete_are(a, b, np.diag(states), [[force]])
    return np.asarray(np.linalg.solve(force + b.T @ cost @ b, b.T @ cost @ a))


def stable(loop: Floats) -> bool:
    return bool(abs(np.linalg.eigvals(loop)).max() < 1)


def request_and_answer(name: str, period_s: float, ticks: int) -> Floats:
    """Return the loop that acts, from a request on, on the state that the last request saw."""
    a, b = held(ticks * period_s)
    return np.block([[a, b], [-gain(name, period_s), 0]])


def every_tick(name: str, period_s: float, ticks: int) -> Floats:
    """Return the loop with so many stored actions, the next one first."""
    a, b = held(period_s)
    if not ticks:
        return a - b @ gain(name, period_s)
    loop = block_diag(a, np.eye(ticks, k=1))
    loop[:4, 4:5] = b
    loop[-1, :4] = -gain(name, period_s)
    return loop


TIMINGS: Final = {"queue?trigger=1": request_and_answer, "replace?execute=1&under_way=many&assumed=0": every_tick}


def last_stable(mode: str, name: str, period_s: float) -> int:
    return next(n for n in count(1) if not stable(TIMINGS[mode](name, period_s, n))) - 1


class LinearCartPole(gymnasium.Env[Floats, Floats]):
    """Observes position, speed, angle, its speed, and the number of the tick; takes any force."""

    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float64)

    def __init__(self, period: float) -> None:
        self.dt = period
        self._a, self._b = held(period)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._x, self._tick = self.np_random.uniform(-0.05, 0.05, 4), 0
        return np.append(self._x, self._tick), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        self._x, self._tick = self._a @ self._x + self._b @ action, self._tick + 1
        fallen = abs(self._x[0]) > 2.4 or abs(self._x[2]) > 0.2095
        reward = -float(self._x @ self._x)
        return np.append(self._x, self._tick), reward, bool(fallen), False, {}


def delayed(period: float, delay: int) -> gymnasium.Env[Floats, Floats]:
    return DelayObservation(LinearCartPole(period), delay)


gymnasium.register("LinearCartPole-v0", f"{HERE}:LinearCartPole")
gymnasium.register("DelayedLinearCartPole-v0", f"{HERE}:delayed")


def lqr(_pictures: object, state: Floats, prompt: str) -> Floats:
    """Return the force of the LQR "NAME PERIOD_S TICK", after the first ticks up to that one; until then none."""
    name, period_s, begins = prompt.split()
    return np.asarray(-gain(name, float(period_s)) @ state[:4] * (state[4] > int(begins)))
