"""The flags of `s2a-bench timeline --live`: which of them go together, and the configuration that they make."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.cli.options import listed, numbers, size_of, text_or_file, whole_numbers
from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from s2a_bench.experiments.timeline.live.config import LiveConfig

DEFAULTS: dict[str, Any] = {
    "transport": "ros",
    "pace": 0.0,
    "skills": "household",
    "task": "",
    "robot": "timed",
    "engine": "llama",
    "model": None,
    "mmproj": None,
    "threads": 0,
    "gpu-layers": 0,
    "source": "synthetic",
    "size": "640x480",
    "url": "",
    "dialect": "",
    "no-grammar": False,
    "warmup": 1,
    "timeout": 60.0,
}
"""What holds with --live where a flag is not given; without --live none may be."""


def given_live(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return those flags that were given."""
    return {name: value for name, value in flags.items() if value is not None and value is not False}


def refuse_without_live(given: Mapping[str, Any]) -> None:
    """Raise UsageError for flags that mean something with --live only."""
    for name in given:
        raise UsageError(f"--{name} is about a model that answers; it needs --live")


def refuse_with_live(flags: Mapping[str, tuple[Any, Any]]) -> None:
    """Raise UsageError for flags, as (value, default), that are about modelled tokens."""
    for name, (value, default) in flags.items():
        if value != default:
            raise UsageError(f"--{name} is about tokens that are modelled; leave it out with --live")


def live_config(
    given: Mapping[str, Any],
    *,
    policy: str,
    profile: str,
    tokens_per_skill: str,
    n_skills: str,
    t_nom: str,
    t_min: float,
    t_max: float,
    plans: int | None,
    seed: int,
) -> LiveConfig:
    """Make the configuration of a live run; raises UsageError naming the flag."""
    from s2a_bench.experiments.timeline.live.config import LiveConfig
    from s2a_bench.harness.plan import LatencyConfig
    from s2a_bench.inference import EngineConfig
    from s2a_bench.transport.http import HTTP
    from s2a_bench.transport.pipeline import first_variants

    value = {**DEFAULTS, **given}
    if "transport" not in given and value["url"]:
        value["transport"] = HTTP.name
    width, height = size_of(value["size"])
    if value["pace"] < 0 or ("pace" in given and not value["pace"]):
        raise UsageError(f"--pace: {value['pace']:g} should be above 0")
    engine = EngineConfig(
        value["engine"],
        _path(value["model"]),
        _path(value["mmproj"]),
        value["threads"],
        value["gpu-layers"],
        profile=profile,
        pace=value["pace"],
    )
    requests = LatencyConfig(
        transports=listed(value["transport"]),
        variants=first_variants(),
        options={HTTP.name: {"url": value["url"], "dialect": value["dialect"]}},
        source=value["source"],
        width=width,
        height=height,
        engine=engine,
        runs=1,
        warmup=value["warmup"],
        seed=seed,
        timeout_s=value["timeout"],
        sample_resources_hz=0,
    )
    return LiveConfig(
        requests=requests,
        policies=listed(policy),
        skills=value["skills"],
        task=text_or_file(value["task"], "--task"),
        tokens_per_skill=whole_numbers("--tokens-per-skill", tokens_per_skill or "6"),
        n_skills=whole_numbers("--n-skills", n_skills),
        t_nom_s=numbers("--t-nom", t_nom),
        t_min=t_min,
        t_max=t_max,
        plans=1 if plans is None else plans,
        robot=value["robot"],
        constrained=not value["no-grammar"],
    )


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None
