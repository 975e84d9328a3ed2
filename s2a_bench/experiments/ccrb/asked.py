"""Who is asked for the plan in a live run, and how; the flags that mean nothing without ``--live``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Options, group, option
from s2a_bench.scenario.ccrb.options import SKILL_SET

if TYPE_CHECKING:
    from s2a_bench.experiments.ccrb.config import CcrbConfig
    from s2a_bench.experiments.timeline.config import TimelineConfig


class Asked(Options):
    """Which model answers, over which transport."""

    live: bool = option(False, "take the tokens of a model that really answers, about the rendered scene")
    transport: str = option("", "--live: ros, ros/action, http, http/VARIANT, shm, loopback [default: ros]")
    engine: EngineConfig = group(EngineConfig, only=("name", "model", "mmproj", "threads", "pace"), about="--live: ")

    track_file: Path | None = option(
        None, "--live: take lambda from what earlier plans taught, and let this one teach: the file of timeline"
    )

    @property
    def replayed(self) -> bool:
        """Whether a board's tokens are replayed instead of a model's."""
        return self.engine.name == "replay"

    def check(self) -> None:
        """Refuse what needs ``live``; raises UsageError naming the field."""
        for name in () if self.live else self.given():
            if name != "live":
                raise UsageError(f"`{name}` is about a model that answers; it needs `live`")


def live_timeline(config: CcrbConfig) -> TimelineConfig:
    """Return the live timeline whose one plan a ccrb run drives; raises UsageError naming the field."""
    from s2a_bench.experiments.timeline.config import TimelineConfig
    from s2a_bench.experiments.timeline.live.config import REPLAY_SKILLS, REPLAY_TOKENS

    asked = config.asked
    if asked.replayed and config.tokens_per_skill != REPLAY_TOKENS:
        raise UsageError(f"`engine` replay writes {REPLAY_TOKENS} tokens a skill; leave out `tokens_per_skill`")
    return TimelineConfig(
        live=True,
        transport=asked.transport,
        engine=asked.engine,
        profiles=(config.profile,) if asked.replayed else (),
        skills=REPLAY_SKILLS if asked.replayed else SKILL_SET,
        policies=config.policies,
        tokens_per_skill=(config.tokens_per_skill,),
        n_skills=(config.scenario.skills,),
        seed=config.seed,
        track_file=asked.track_file,
    )
