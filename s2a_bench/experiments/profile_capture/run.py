"""Measure this machine as a hardware profile: requests with new pictures, and every gap between tokens."""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from s2a_bench.boards.fit import fit_gaps
from s2a_bench.boards.gaps import to_table
from s2a_bench.boards.profile import Profile, parse_profile, to_toml
from s2a_bench.clock import now_ns
from s2a_bench.errors import EngineError, StoreError, UsageError
from s2a_bench.experiments.profile_capture import LEAST_GAPS, CaptureConfig
from s2a_bench.frames import open_source
from s2a_bench.frames.convert import bgr_to_rgb, to_bgr
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.warnings import Counters, before_run
from s2a_bench.inference import Engine, need_engine
from s2a_bench.inference.models import resolve
from s2a_bench.machine import environment
from s2a_bench.machine.environment import board_facts
from s2a_bench.machine.tuning import limit_threads
from s2a_bench.progress import Progress
from s2a_bench.types import Request

_MODEL_FACTS = (
    "name",
    "architecture",
    "model_type",
    "quantisation",
    "parameters",
    "dummy",
    "pictures",
    "model",
    "model_sha256",
    "mmproj",
    "mmproj_sha256",
    "llama_cpp_python",
    "threads",
    "gpu_layers",
    "context",
    "flash_attention",
)


@dataclass(frozen=True, slots=True)
class TimedAnswer:
    """The times of one request: to its first token, and from each token to the next."""

    ttft_ns: int
    gaps_ns: list[int]


def answers(engine: Engine, config: CaptureConfig) -> Generator[TimedAnswer, None, None]:
    """Yield the times of requests without end, each with a new picture and seed; raises EngineError if empty."""
    with closing(Stamped(open_source(config.source, *config.size, seed=config.seed), "capture")) as source:
        for number in count():
            frame = source.read()
            picture = replace(frame, encoding="rgb8", data=bgr_to_rgb(to_bgr(frame)))
            request = Request(f"capture-{number}", config.prompt, (picture,), config.tokens, seed=config.seed + number)
            started = now_ns()
            times = [now_ns() for _ in engine.generate(request)]
            if not times:
                raise EngineError(f"request {request.id}: the answer was empty; give another `prompt`")
            yield TimedAnswer(times[0] - started, [after - before for before, after in pairwise(times)])


def capture(config: CaptureConfig, progress: Progress) -> dict[str, Any]:
    """Measure, and return the profile as the tables of its file; raises EngineError for short answers."""
    need_engine(config.engine)
    from s2a_bench.inference.llama_cpp import LlamaCppEngine

    limit_threads()
    progress.expect(config.warmup + config.requests)
    warnings = before_run()
    model, mmproj = resolve(config.engine)
    progress.stage("loading the model")
    # on this thread: another one would hand tokens over late, and several at once
    engine = LlamaCppEngine(config.engine.but(model=model, mmproj=mmproj))
    with closing(engine), closing(answers(engine, config)) as timed:
        before = Counters.read(watches_udp=False)
        recorded = []
        for number in range(config.warmup + config.requests):
            progress.stage("warming up" if number < config.warmup else "measuring")
            recorded.append(next(timed))
            progress.advance()
        warnings += Counters.read(watches_udp=False).warnings_since(before)
        described = engine.describe()
    progress.stage("fitting the gaps")
    warning_lines = [f"{warning.code}: {warning.message}; {warning.advice}" for warning in warnings]
    return document(config, recorded, described, warning_lines)


def document(
    config: CaptureConfig, recorded: list[TimedAnswer], model: dict[str, Any], warnings: list[str]
) -> dict[str, Any]:
    """Turn timed answers, warm-ups first, into the tables of a profile's file."""
    counted = recorded[config.warmup :]
    rows = [[gap / 1e9 for gap in answer.gaps_ns] for answer in counted]
    total = sum(map(len, rows))
    if total < LEAST_GAPS:
        raise EngineError(
            f"the answers were short: {total} gaps in {len(counted)} requests, a profile needs {LEAST_GAPS}; "
            "give more `requests`, or a `prompt` that asks for more"
        )
    fit = fit_gaps(rows)
    mean_s = sum(map(sum, rows)) / total
    ttft = np.array([answer.ttft_ns for answer in counted]) / 1e9
    prompt_s = max(0.0, float(ttft.mean()) - mean_s)
    spread = float(ttft.std(ddof=1)) if len(ttft) > 1 else 0.0
    board = board_facts()
    machine = environment.collect()
    return {
        "title": config.title or str(board.get("model") or board.get("gpu") or board.get("cpu") or machine["host"]),
        "origin": "measured",
        "tokens_per_s": 1 / mean_s,
        "prompt_s": prompt_s,
        "prompt_cv": spread / prompt_s if prompt_s else 0.0,
        "rate_cv": rate_cv(rows),
        "gaps": to_table(fit.gaps),
        "board": board,
        "model": {key: model[key] for key in _MODEL_FACTS if key in model},
        "capture": {
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "engine": config.engine.name,
            **config.model_dump(include={"requests", "warmup", "tokens", "source", "prompt", "seed"}),
            "size": "{}x{}".format(*config.size),
            "gaps": total,
            "ttft_mean_s": float(ttft.mean()),
            "warnings": warnings,
        },
        "fit": {
            "family": fit.family,
            "criterion": "KS distance of gaps, and of sums of 6, to the half of the requests that the fit has not seen",
            "lag1": round(fit.lag1, 4),
            "distance_gap": {name: round(gap, 4) for name, (gap, _) in fit.distances.items()},
            "distance_sum": {name: round(total, 4) for name, (_, total) in fit.distances.items()},
        },
        "environment": {key: value for key, value in machine.items() if key not in {"cpu", "board", "governor"}},
        "trace": {
            "warmups": config.warmup,
            "ttft_ns": [answer.ttft_ns for answer in recorded],
            "gaps_ns": [answer.gaps_ns for answer in recorded],
        },
    }


def rate_cv(rows: list[list[float]]) -> float:
    """Return the spread of requests' mean gaps beyond that of independent gaps, as a share of the mean."""
    long = [row for row in rows if len(row) > 1]
    if len(long) < 2:  # noqa: PLR2004 - one request has no spread
        return 0.0
    means = np.array([np.mean(row) for row in long])
    within = np.mean([np.var(row, ddof=1) / len(row) for row in long])
    return float(np.sqrt(max(0.0, means.var(ddof=1) - within)) / means.mean())


def write_profile(tables: dict[str, Any], path: Path, *, force: bool) -> Profile:
    """Write the file and return its profile; raises UsageError if the file exists, else StoreError."""
    text = to_toml(tables)
    profile = parse_profile(path.stem, text, f"profile {path}")
    prepare_file(path, force=force)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error
    return profile


def prepare_file(path: Path, *, force: bool) -> None:
    """Create the file's folder before measuring; raises as `write_profile`."""
    if path.exists() and not force:
        raise UsageError(f"{path} exists already; give another NAME or `output`, or `force` to replace it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error
    if not os.access(path.parent, os.W_OK):
        raise _unwritable(path, "the folder may not be written to")


def _unwritable(path: Path, why: str) -> StoreError:
    return StoreError(f"`output`: cannot write {path}: {why}")
