"""What a live timeline is asked besides what is compared: which model, over which transport, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Options, Size, TextOrFile, group, option
from s2a_bench.runtime import ROBOTS

if TYPE_CHECKING:
    from s2a_bench.experiments.timeline.config import TimelineConfig
    from s2a_bench.harness.plan import RequestsConfig
    from s2a_bench.plan import SkillSet

REPLAY_TOKENS: Final = 6
"""Tokens a skill of the replay engine, which writes household plans in the paper's format."""
REPLAY_SKILLS: Final = "household"


class Live(Options):
    """Options about a model that answers."""

    transport: str = option("", "--live: ros, ros/action, http, http/VARIANT, shm, loopback [default: ros]")
    skills: str = option("household", "--live: household, driving, or a TOML file")
    task: TextOrFile = option("", "--live: what the robot should do, text or @FILE")
    robot: str = option("timed", f"--live: {', '.join(ROBOTS)}; timed only waits")
    engine: EngineConfig = group(
        EngineConfig, only=("name", "model", "mmproj", "threads", "gpu_layers", "pace"), about="--live: "
    )
    source: str = option("synthetic", "--live: the camera")
    size: Size = option((640, 480), "--live: WIDTHxHEIGHT of the frames [default: 640x480]")
    url: str = option("", "--live: an HTTP server that runs already (a black box)")
    dialect: str = option("", "--live: what --url speaks [default: ask]")
    nonce: str = option("", "--live: nonce of another run, to send its very pictures again [default: a new one]")
    no_grammar: bool = option(False, "--live: let the model write what it likes")
    warmup: int = option(1, "--live: answers before, which policies learn the rate from", ge=0)
    timeout_s: float = option(
        60.0, "--live: seconds without a token after which the robot holds", flag="timeout", ge=0.1, le=86_400
    )


def requests_of(config: TimelineConfig) -> RequestsConfig:
    """Return how the model is asked: one transport in one variant; prompt and length follow from the plan."""
    from s2a_bench.harness.plan import RequestsConfig
    from s2a_bench.transport.http import HTTP
    from s2a_bench.transport.pipeline import first_variants
    from s2a_bench.transport.ros import ROS

    transport = config.transport or (HTTP.name if config.url else ROS.name)
    return RequestsConfig(
        transports=(transport,),
        variants=first_variants(),
        options={HTTP.name: {"url": config.url, "dialect": config.dialect}},
        source=config.source,
        size=config.size,
        engine=config.engine.but(profile=",".join(config.profiles)) if config.profiles else config.engine,
        runs=1,
        warmup=config.warmup,
        seed=config.seed,
        nonce=config.nonce,
        timeout_s=config.timeout_s,
        sample_resources_hz=0,
    )


def check_live(config: TimelineConfig) -> None:
    """Refuse what no model, robot or policy can do; raises UsageError naming the fields."""
    from s2a_bench.policy import PlanShape, Timing

    requests = requests_of(config)
    if len(requests.pipelines) != 1:
        raise UsageError("`transport`: `live` follows one stream; name one, as ros, ros/action or http/binary")
    _ = config.skill_set
    for policy in config.chosen.values():
        policy.stepper(PlanShape(1, 1, Timing(1.0, 1.0, 1.0)))
    if len(config.chosen) > 1 and not getattr(ROBOTS[config.robot], "several", False):
        raise UsageError(f"`robot`: {config.robot} follows one policy at a time; choose it with `policies`")
    engine = config.engine
    if engine.pace and config.url:
        raise UsageError("`pace` needs our own server, which holds its engine back")
    if engine.name == "echo":
        raise UsageError("`engine` echo writes no plans; `live` needs llama, or replay")
    if engine.name == "replay":
        if engine.pace:
            raise UsageError("`pace`: `engine` replay has its profile's rate; leave one of them out")
        if config.skills != REPLAY_SKILLS or config.lengths != (REPLAY_TOKENS,):
            raise UsageError(
                f"`engine` replay writes plans of the {REPLAY_SKILLS} skills in {REPLAY_TOKENS} tokens a skill; "
                "leave out `skills` and `tokens_per_skill`"
            )


def in_paper_format(config: TimelineConfig) -> bool:
    """Return True if plans are written as in the paper, for want of a tokenizer to choose a format with."""
    return config.engine.name != "llama" or bool(config.url)


def settings_asked(config: TimelineConfig) -> list[tuple[int, int, float | None]]:
    """List what is asked for: tokens a skill, skills, and T_nom in s (None: the set's own)."""
    return list(product(config.lengths, config.n_skills, config.t_nom_s or (None,)))


def skills_lasting(config: TimelineConfig, t_nom_s: float | None) -> SkillSet:
    """Return the skill set, every skill of which takes ``t_nom_s`` if that is given."""
    from s2a_bench.plan import Durations

    if t_nom_s is None:
        return config.skill_set
    times = Durations(config.t_min * t_nom_s, t_nom_s, config.t_max * t_nom_s)
    skills = tuple(replace(skill, durations=times) for skill in config.skill_set.skills)
    return replace(config.skill_set, skills=skills)
