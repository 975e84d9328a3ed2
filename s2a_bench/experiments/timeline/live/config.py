"""What a live timeline is asked to do: which model, over which transport, writing which plans; and what it refuses."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import LatencyConfig
from s2a_bench.harness.ranges import LEAST_T_NOM_S, require
from s2a_bench.plan import Durations, SkillSet, load_skills
from s2a_bench.policy import PlanShape, Policy, Timing, policies
from s2a_bench.runtime import ROBOTS

FASTEST: Final = 10_000.0
"""Tokens/s; a pace beyond it sets nothing."""
REPLAY_TOKENS: Final = 6
"""Tokens a skill of the replay engine, which writes household plans in the paper's format."""
REPLAY_SKILLS: Final = "household"


@dataclass(frozen=True)
class LiveConfig:
    """The settings of one ``s2a-bench timeline --live`` run."""

    requests: LatencyConfig
    """How the model is asked: one transport in one variant; prompt, grammar and length follow from the plan."""
    policies: tuple[str, ...] = ("naive", "wait-then-act", "stream-to-act")
    skills: str = "household"
    task: str = ""
    """What the robot should do, in the user's words."""
    tokens_per_skill: tuple[int, ...] = (6,)
    n_skills: tuple[int, ...] = (8,)
    t_nom_s: tuple[float, ...] = ()
    """Durations that every skill gets; empty: the skill set's own."""
    t_min: float = 0.8
    t_max: float = 1.5
    plans: int = 1
    robot: str = "timed"
    constrained: bool = True
    """Whether a grammar holds the model to the plan's form and length."""

    @cached_property
    def skill_set(self) -> SkillSet:
        """Load the skills; raises UsageError."""
        return load_skills(self.skills)

    @cached_property
    def chosen(self) -> dict[str, Policy]:
        """Build the policies, by their canonical names; raises UsageError."""
        return policies(self.policies)

    @property
    def foreign(self) -> bool:
        """Tell whether somebody else's server answers, whose tokenizer is not at hand."""
        return bool(self.requests.foreign)

    @property
    def paper_format(self) -> bool:
        """Tell whether plans are written as in the paper, for want of a tokenizer to choose a format with."""
        started = any(each.transport.program(each.options) for each in self.requests.pipelines)
        return self.requests.engine.name != "llama" or (self.foreign and not started)

    def settings(self) -> list[tuple[int, int, float | None]]:
        """List what is asked for: tokens a skill, skills, and T_nom in s (None: the set's own)."""
        return list(product(self.tokens_per_skill, self.n_skills, self.t_nom_s or (None,)))

    def skills_lasting(self, t_nom_s: float | None) -> SkillSet:
        """Return the skill set, every skill of which takes ``t_nom_s`` if that is given."""
        if t_nom_s is None:
            return self.skill_set
        times = Durations(self.t_min * t_nom_s, t_nom_s, self.t_max * t_nom_s)
        return replace(self.skill_set, skills=tuple(replace(skill, durations=times) for skill in self.skill_set.skills))

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError naming the flag."""
        requests = self.requests
        requests.check()
        _ = self.skill_set
        if len(requests.pipelines) != 1:
            raise UsageError("`transport`: `live` follows one stream; name one, as ros, ros/action or http/binary")
        for policy in self.chosen.values():
            policy.stepper(PlanShape(1, 1, Timing(1.0, 1.0, 1.0)))
        if not self.policies:
            raise UsageError("--policy: name at least one")
        require("--tokens-per-skill", self.tokens_per_skill, 1)
        require("--n-skills", self.n_skills, 1)
        require("--t-nom", self.t_nom_s, LEAST_T_NOM_S)
        require("--t-min (a factor of T_nom)", [self.t_min], 0, 1, above=True)
        require("--t-max (a factor of T_nom)", [self.t_max], 1)
        require("--plans", [self.plans], 1)
        for flag, values in (("--tokens-per-skill", self.tokens_per_skill), ("--n-skills", self.n_skills)):
            if not values:
                raise UsageError(f"{flag}: name at least one")
        self._check_engine()
        robot = ROBOTS[self.robot]
        if len(self.chosen) > 1 and not getattr(robot, "several", False):
            raise UsageError(f"`robot`: {self.robot} follows one policy at a time; choose it with `policy`")

    def _check_engine(self) -> None:
        engine = self.requests.engine
        pace = engine.pace
        if pace:
            require("--pace", [pace], 0, FASTEST, above=True)
            if self.foreign:
                raise UsageError("--pace needs our own server, which holds its engine back")
        if engine.name == "echo":
            raise UsageError("--engine echo writes no plans; --live needs llama, or replay")
        if engine.name == "replay":
            if pace:
                raise UsageError("--pace: --engine replay has its profile's rate; leave one of them out")
            if self.skills != REPLAY_SKILLS or self.tokens_per_skill != (REPLAY_TOKENS,):
                raise UsageError(
                    f"--engine replay writes plans of the {REPLAY_SKILLS} skills in {REPLAY_TOKENS} tokens a skill; "
                    "leave out --skills and --tokens-per-skill"
                )

    def to_manifest(self) -> dict[str, Any]:
        """Return the settings as plain data."""
        own = {name: value for name, value in asdict(self).items() if name != "requests"}
        return {**self.requests.to_manifest(), **own, "time": "live"}
