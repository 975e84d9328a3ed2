"""Who is asked for the plan in a live run, and how; the flags that mean nothing without ``--live``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import UsageError
from s2a_bench.inference import ENGINES
from s2a_bench.options import Options, option
from s2a_bench.scenario.ccrb.options import SKILL_SET

if TYPE_CHECKING:
    from s2a_bench.experiments.ccrb.config import CcrbConfig
    from s2a_bench.experiments.timeline.live.config import LiveConfig

SIZE: Final = (640, 480)


class Asked(Options):
    """Which model answers, over which transport; None is not given."""

    live: bool = option(False, "take the tokens of a model that really answers, about the rendered scene")
    transport: str | None = option(None, "--live: ros, ros/action, http, http/VARIANT, loopback [default: ros]")
    pace: float | None = option(
        None, "--live: hold the answer back to so many tokens/s [default: the model's own]", gt=0, allow_inf_nan=False
    )
    engine: str | None = option(None, f"--live: {', '.join(ENGINES)} [default: llama]")
    model: Path | None = option(None, "--live: GGUF model [default: the tiny dummy]")
    mmproj: Path | None = option(None, "--live: GGUF vision tower that goes with --model")
    threads: int | None = option(None, "--live: CPU threads of the model [default: all]", ge=0)

    @property
    def replayed(self) -> bool:
        """Whether a board's tokens are replayed instead of a model's."""
        return self.engine == "replay"

    def check(self) -> None:
        """Refuse what needs ``live``; raises UsageError naming the field."""
        for name in type(self).model_fields:
            if name != "live" and not self.live and getattr(self, name) is not None:
                raise UsageError(f"`{name}` is about a model that answers; it needs `live`")


def live_config(config: CcrbConfig) -> LiveConfig:
    """Return how the model is asked for the plan of a ccrb run; raises UsageError naming the field."""
    from s2a_bench.experiments.timeline.live.config import REPLAY_SKILLS, REPLAY_TOKENS, LiveConfig
    from s2a_bench.harness.plan import LatencyConfig
    from s2a_bench.inference import EngineConfig
    from s2a_bench.transport.pipeline import first_variants

    asked = config.asked
    if asked.replayed and config.tokens_per_skill != REPLAY_TOKENS:
        raise UsageError(f"`engine` replay writes {REPLAY_TOKENS} tokens a skill; leave out `tokens_per_skill`")
    engine = EngineConfig(
        asked.engine or "llama",
        asked.model,
        asked.mmproj,
        asked.threads or 0,
        profile=config.profile if asked.replayed else "",
        pace=asked.pace or 0.0,
    )
    requests = LatencyConfig(
        transports=(asked.transport or "ros",),
        variants=first_variants(),
        width=SIZE[0],
        height=SIZE[1],
        engine=engine,
        runs=1,
        warmup=1,
        seed=config.seed,
        timeout_s=60.0,
        sample_resources_hz=0,
    )
    return LiveConfig(
        requests=requests,
        policies=config.policies,
        skills=REPLAY_SKILLS if asked.replayed else SKILL_SET,
        tokens_per_skill=(config.tokens_per_skill,),
        n_skills=(config.scenario.skills,),
    )
