"""A gymnasium environment as a robot: one step a control tick, with the action of that tick."""

from __future__ import annotations

import re
from ast import literal_eval
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from s2a_bench import extras
from s2a_bench.act import Outcome, TaskKind, TaskRobot
from s2a_bench.errors import RequestFailed, RobotError, UsageError
from s2a_bench.types import Pixels, Vector
from s2a_bench.vectors import state_of

SUCCESS: Final = ("is_success", "success")
"""Keys of a step's ``info``: gymnasium-robotics, gym-pusht, gym-aloha, lerobot; Meta-World, ManiSkill."""
RENDER, NONE = "render", "none"
_SLICE: Final = re.compile(r"state\[(\d+):(\d+)\]")


@dataclass(frozen=True, slots=True)
class Gym(TaskKind):
    """The environment ``env``, or PACKAGE:ID of a package that registers it when it is imported.

    Other parameters are keywords of ``gymnasium.make``. ``state`` and ``picture`` are keys of the observation; by
    default the state is all of it, and the picture is rendered; ``none`` sends no picture. An episode ends with the
    environment's, or at a success: ``info`` is the environment's word, ``terminated`` its end, ``survival`` none before
    its limit of steps, ``return`` a sum of rewards of ``least``. Before the first action it takes the neutral one, the
    nearest to 0; in a ``stall`` that, or the last action again. ``position=state[0:3]`` is what jerk and path are of,
    by default the actions.
    """

    risk: ClassVar[str] = "program"
    passes_on: ClassVar[str] = "keywords"

    env: str = ""
    state: str = ""
    picture: str = RENDER
    success: Literal["info", "terminated", "survival", "return"] = "info"
    least: float | None = None
    stall: Literal["repeat", "neutral"] = "repeat"
    position: str = ""
    keywords: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if not self.env:
            raise UsageError("env: name an environment, as in env=CartPole-v1")
        if self.position and not _SLICE.fullmatch(self.position):
            raise UsageError(f"position = '{self.position}' should look like state[0:3]")
        if (self.success == "return") == (self.least is None):
            raise UsageError("success=return needs least=SUM of rewards, no other does")

    @property
    def period_ns(self) -> int:
        return _period_ns(self)

    def open_actions(self, dims: int, period_ns: int) -> GymRobot:  # noqa: ARG002 - the environment knows
        return GymRobot(self, period_ns)

    def make_env(self) -> Any:
        """Make the environment; raises S2AError."""
        gymnasium = extras.require("gymnasium", "gym")
        gymnasium.logger.min_level = gymnasium.logger.ERROR
        keywords: dict[str, Any] = {"render_mode": "rgb_array"} if self.picture == RENDER else {}
        for name, text in self.keywords:
            keywords[name] = text
            with suppress(ValueError, SyntaxError):
                keywords[name] = literal_eval(text)
        hints = "a package first: env=PACKAGE:ID; no render_mode: picture=none"
        with self.called(f"cannot be made ({hints})", UsageError):
            env = gymnasium.make(self.env, disable_env_checker=True, **keywords)
        if not isinstance(env.action_space, (gymnasium.spaces.Box, gymnasium.spaces.Discrete)):
            raise UsageError(f"`robot`: gym: {self.env} takes actions of {env.action_space}, not of Box or Discrete")
        return env

    @contextmanager
    def called(self, what: str, kind: type[RobotError | UsageError] = RobotError) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # an environment may raise anything
            raise kind(f"`robot`: gym: {self.env} {what}: {type(error).__name__}: {error}") from error


def _period(env: Any) -> tuple[int, str] | None:
    """Return the period of an environment in ns, and where that is written; None: nowhere."""
    rate = env.metadata.get("render_fps")
    periods_s = {name: getattr(env.unwrapped, name, None) for name in ("dt", "tau")}
    periods_s["render_fps"] = 1 / rate if rate else None
    for name, period_s in periods_s.items():
        if isinstance(period_s, (int, float, np.floating)) and period_s > 0:
            return round(period_s * 1e9), name
    return None


@cache
def _period_ns(kind: Gym) -> int:
    """Return the period that the environment of a kind names; raises S2AError."""
    with closing(kind.make_env()) as env:
        period = _period(env)
    if period is None:
        names = "no period (dt, tau, render_fps)"
        raise UsageError(f"`control_hz`: {kind.env} names {names}; say how often it takes actions")
    return period[0]


class GymRobot(TaskRobot):
    """An open environment."""

    def __init__(self, kind: Gym, period_ns: int) -> None:
        self._kind, self._period_s = kind, period_ns / 1e9
        self._env = kind.make_env()
        space = self._env.action_space
        self._discrete = not hasattr(space, "high")
        bounds = (space.start, space.start + space.n - 1) if self._discrete else (space.low, space.high)
        self._low, self._high = (np.ravel(bound).astype(np.float64) for bound in bounds)
        self._dims = self._low.size
        place = _SLICE.fullmatch(kind.position)
        self._place = slice(*map(int, place.groups())) if place else slice(0)
        self.begin(0)
        first = deepcopy(self._seen)
        self.begin(0)
        same = extras.require("gymnasium.utils.env_checker", "gym").data_equivalence
        if not same(first, self._seen):
            raise RobotError(f"`robot`: gym: {kind.env} begins differently with the same seed: rows would not compare")
        if self._place.stop > (numbers := len(self.state())):
            raise RobotError(f"`robot`: gym: {kind.position}: the state has {numbers} numbers")

    def begin(self, seed: int) -> None:
        with self._kind.called("cannot be reset"):
            if callable(older := getattr(self._env.unwrapped, "seed", None)):  # gym's, which Meta-World's goals need
                older(seed)
            self._seen, info = self._env.reset(seed=seed)
        self._seed, self.over = seed, False
        self._action = np.zeros(self._dims)
        self._reward, self._terminated, self._truncated, self._done = 0.0, False, False, _done(info)
        self._path: list[NDArray[np.float64]] = []

    def send(self, action: Vector | None, at_ns: int) -> None:  # noqa: ARG002 - a step a tick
        if self.over:
            self.begin(self._seed + 1)
        if action is not None and action.shape != (self._dims,):
            raise RobotError(f"`robot`: gym: an action of shape {action.shape}; {self._kind.env} takes ({self._dims},)")
        if action is not None:
            self._action = np.asarray(action, np.float64)
        elif self._kind.stall == "neutral":
            self._action = np.zeros(self._dims)
        space = self._env.action_space
        whole = np.issubdtype(space.dtype, np.integer)
        taken = np.clip(np.rint(self._action) if whole else self._action, self._low, self._high)
        env_action = int(taken[0]) if self._discrete else taken.reshape(space.shape).astype(space.dtype)
        with self._kind.called("raised"):
            self._seen, reward, self._terminated, self._truncated, info = self._env.step(env_action)
        self._reward += float(reward)
        if (done := _done(info)) is not None:
            self._done = bool(self._done) or done
        self._path.append(np.array(self.state()[self._place]) if self._kind.position else taken)
        self.over = bool(self._terminated or self._truncated or (self._kind.success == "info" and self._done))

    def state(self) -> tuple[float, ...]:
        key = self._kind.state
        if key == NONE:
            return ()
        if not key and isinstance(self._seen, dict):
            raise RobotError(f"`robot`: gym: state: name a key of the observation: {', '.join(self._seen)}, or {NONE}")
        try:
            return state_of(np.atleast_1d(self._at(key)))
        except RequestFailed as error:
            raise RobotError(f"`robot`: gym: {error}; name a key of the observation, or state={NONE}") from error

    def picture(self) -> Pixels | None:
        key = self._kind.picture
        if key == NONE:
            return None
        with self._kind.called(f"cannot be rendered (picture={NONE} does without)") if key == RENDER else nullcontext():
            pixels = np.array(self._env.render() if key == RENDER else self._at(key))
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:  # noqa: PLR2004 - RGB
            raise RobotError(f"`robot`: gym: picture: {key} is {pixels.dtype} {pixels.shape}, not uint8 (h, w, 3)")
        return pixels

    def outcome(self) -> Outcome:
        kind = self._kind
        if kind.success == "info" and self._done is None:
            raise RobotError(
                f"`robot`: gym: {kind.env} says nothing of success (info has none of {', '.join(SUCCESS)}); add "
                "success=survival, success=terminated, or success=return&least=SUM"
            )
        success = {
            "info": bool(self._done),
            "terminated": self._terminated,
            "survival": not self._terminated,
            "return": kind.least is not None and self._reward >= kind.least,
        }[kind.success]
        path = np.array(self._path).reshape(len(self._path), -1)
        jerk = np.diff(path, 3, axis=0) / self._period_s**3
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        return Outcome(success, self._reward, length, float(np.sqrt(np.mean(jerk**2))) if jerk.size else 0.0)

    def describe(self) -> dict[str, str]:
        kind = self._kind
        keywords = "&".join(f"{name}={text}" for name, text in kind.keywords)
        own_ns, name = _period(self._env) or (0, "")
        if own_ns == round(self._period_s * 1e9):
            period = f"{own_ns / 1e6:g} ms, of {name}"
        else:
            period = f"{self._period_s * 1e3:g} ms, of control_hz"
            period += f", not {own_ns / 1e6:g} ms, of {name}" if name else ""
        facts = {"robot": "gym", "env": kind.env, "keywords": keywords, "success": kind.success, "stall": kind.stall}
        return {**facts, "period": period}

    def close(self) -> None:
        self._env.close()

    def _at(self, key: str) -> Any:
        """Return the observation's value at a key, PARENT.CHILD within another, or all of it."""
        seen = self._seen
        for name in key.split(".") if key else ():
            if not isinstance(seen, dict) or name not in seen:
                keys = f"; it has {', '.join(seen)}" if isinstance(seen, dict) else ""
                raise RobotError(f"`robot`: gym: the observation of {self._kind.env} has no '{key}'{keys}")
            seen = seen[name]
        return seen


def _done(info: dict[str, Any]) -> bool | None:
    """Return whether a step's info says that the task is done; None: it says nothing."""
    return next((bool(info[key]) for key in SUCCESS if key in info), None)
