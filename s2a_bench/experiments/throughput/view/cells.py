"""What a throughput run says about each of its cells: rates and times of every request, gaps, rates by position.

The rate of a request is told twice. ``tokens_per_s`` is the paper's (section V-D): N_tokens / T_eval, T_eval being the
engine's own time from the end of the prompt to the last token; where a server does not tell it, the other stands in.
``decode_tokens_per_s`` is what the client saw: (n - 1) / (t_last - t_first), so that sending counts.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.latency.view.cells import Cell, by_launch, cells_of, launches_of, with_launch
from s2a_bench.experiments.throughput.rows import REFERENCE
from s2a_bench.facts import (
    END_N,
    FIRST_DECODE_MS,
    PREDICTED_MS,
    PREDICTED_N,
    PREDICTED_STEPS,
    PREPROCESS_MS,
    PROMPT_EVAL_MS,
    PROMPT_MS,
    PROMPT_N,
    VISION_ENCODE_MS,
)
from s2a_bench.machine.resources.rows import ENERGY_J
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.transport import declared

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.stats import Ratio
    from s2a_bench.store.run import Run

METRICS = (
    "tokens_per_s",
    "decode_tokens_per_s",
    "ttft_ms",
    "prompt_ms",
    "preprocess_ms",
    "vision_encode_ms",
    "image_ms",
    "prompt_eval_ms",
    "first_decode_ms",
    "prompt_tokens",
    "prefill_tokens_per_s",
    "tokens_per_joule",
)
"""The numbers of one request, by the names of ``--json``; one that a cell does not have is absent."""

RATIO_METRIC = "decode_tokens_per_s"
"""What cells and the reference are compared by."""

ENGINE_METRIC = "tokens_per_s"
"""What engines are compared by besides: sending is not in it."""

LLAMA_BENCH: Final = "llama-bench"
"""How the reference is called where cells are listed."""

_SAMPLE = ("request_id", "launch", "block", "ttft_ns", "facts")

BIN = 32
"""Tokens of one bin of the rates by position."""


@dataclass(frozen=True)
class Speed:
    """One cell of a throughput run."""

    cell: Cell

    @property
    def name(self) -> str:
        """Name the cell."""
        return self.cell.name

    @cached_property
    def requests(self) -> pd.DataFrame:
        """Return a row a request that counts, with its place and a column a metric; NaN where it has none."""
        import pandas as pd

        times = self.cell.tokens.groupby("request_id")["client_ns"].agg(["min", "max", "size"])
        rows = []
        good = self.cell.good
        for request, launch, block, ttft_ns, facts in zip(*(good[name] for name in _SAMPLE), strict=True):
            first_ns, last_ns, events = (int(value) for value in times.loc[request])
            numbers = _metrics(json.loads(str(facts)), events, (last_ns - first_ns) / 1e9)
            place = {"launch": launch, "block": block}
            rows.append({**place, **numbers, "ttft_ms": None if pd.isna(ttft_ns) else ttft_ns / 1e6})
        return pd.DataFrame(rows, columns=["launch", "block", *METRICS, "tokens", "events", "told"])

    def values(self, metric: str) -> Floats:
        """Return the values of a metric, one a request that has it."""
        return self.requests[metric].dropna().to_numpy(dtype="float64")

    def by_launch(self, metric: str) -> dict[int, dict[int, list[float]]]:
        """Return the values of a metric by the launch and the block in which they were taken."""
        there = self.requests[self.requests[metric].notna()]
        return by_launch(there, there[metric])

    def by_position(self) -> dict[tuple[int, int], Floats]:
        """Return (first, last token of a bin, from 0) -> decode rates there, one a request that got so far.

        The gap before token i belongs to the bin of i; token 0 has none.
        """
        answers = self.cell.answers
        gaps = answers.assign(bin=answers["index"] // BIN).dropna(subset="gap_ns")
        spent = gaps.groupby(["bin", "request_id"])["gap_ns"].agg(["sum", "size"])
        spent = spent[spent["sum"] > 0].reset_index()
        found: dict[tuple[int, int], Floats] = {}
        for place in sorted({int(place) for place in spent["bin"]}):
            of_bin = spent[spent["bin"] == place]
            rates = of_bin["size"].to_numpy(dtype="float64") / of_bin["sum"].to_numpy(dtype="float64") * 1e9
            found[place * BIN, place * BIN + BIN - 1] = rates
        return found

    @property
    def told(self) -> bool:
        """Return whether the engine said how long it evaluated; else the paper's rate is the client's."""
        return bool(self.requests["told"].any())

    @property
    def joined(self) -> int:
        """Count tokens that came together with another, as where a server holds back half a character."""
        return int((self.requests["tokens"] - self.requests["events"]).clip(lower=0).sum())


def _metrics(facts: dict[str, float], events: int, span_s: float) -> dict[str, Any]:
    """Derive one request's numbers; the server's own count of tokens, its invisible last left out, where it tells one.

    ``predicted_steps`` is a fact where the engine's own time covers other than ``predicted_n`` tokens (vLLM).
    """
    tokens = int((facts.get(PREDICTED_N) or events) - facts.get(END_N, 0))
    found: dict[str, Any] = {"tokens": tokens, "events": events}
    found |= {str(fact): facts[fact] for fact in (PREPROCESS_MS, VISION_ENCODE_MS, FIRST_DECODE_MS) if fact in facts}
    if tokens > 1 and span_s > 0:
        found["decode_tokens_per_s"] = (tokens - 1) / span_s
    found["told"] = bool(facts.get(PREDICTED_MS))
    if found["told"]:
        found["tokens_per_s"] = facts.get(PREDICTED_STEPS, tokens) / facts[PREDICTED_MS] * 1e3
    elif "decode_tokens_per_s" in found:
        found["tokens_per_s"] = found["decode_tokens_per_s"]
    if PROMPT_MS in facts:
        found["prompt_ms"] = facts[PROMPT_MS]
        if PROMPT_EVAL_MS in facts:
            found |= {
                "prompt_eval_ms": facts[PROMPT_EVAL_MS],
                "image_ms": facts[PROMPT_MS] - facts[PROMPT_EVAL_MS],
            }
        if facts.get(PROMPT_N) and facts[PROMPT_MS] > 0:
            found["prefill_tokens_per_s"] = facts[PROMPT_N] / facts[PROMPT_MS] * 1e3
    if facts.get(PROMPT_N):
        found["prompt_tokens"] = facts[PROMPT_N]
    if facts.get(ENERGY_J):
        found["tokens_per_joule"] = tokens / facts[ENERGY_J]
    return found


def speeds_of(run: Run) -> list[Speed]:
    """Split a run into its cells: in-process first, then HTTP and ROS."""
    return _speeds(cells_of(run))


def speeds_by_launch(run: Run) -> list[tuple[int, list[Speed]]]:
    """Return launch and cells for every launch of a run."""
    return [(launch, _speeds(cells)) for launch, cells in launches_of(run)]


def _speeds(cells: list[Cell]) -> list[Speed]:
    return sorted(map(Speed, cells), key=lambda speed: not declared(speed.cell.pipeline).in_process)


def reference_by_launch(run: Run) -> dict[int, dict[int, list[float]]]:
    """Return llama-bench's tokens/s by launch and block, its warm-ups left out."""
    rows = with_launch(run.table(REFERENCE))
    counted = rows[~rows["warmup"]]
    return by_launch(counted, counted["n_gen"] / counted["decode_ns"] * 1e9)


def reference_values(run: Run) -> list[float]:
    """Return llama-bench's tokens/s in the order of the blocks."""
    launches = sorted(reference_by_launch(run).items())
    return [value for _, blocks in launches for _, values in sorted(blocks.items()) for value in values]


def reference_depths(run: Run) -> list[int]:
    """Return how many tokens lay before those that llama-bench timed: one number where all prompts are alike."""
    rows = run.table(REFERENCE)
    return sorted({int(depth) for depth in rows[~rows["warmup"]]["depth"]})


def ratios_of(run: Run, speeds: list[Speed]) -> Iterator[tuple[str, str, Ratio]]:
    """Yield cell, base and ratio: every cell to llama-bench where it ran, and every other cell to in-process."""
    reference = reference_by_launch(run)
    base = _in_process(speeds)
    for speed in speeds:
        values = speed.by_launch(RATIO_METRIC)
        if ratio := ratio_of_launches(values, reference, run.bootstrap_seed):
            yield speed.name, LLAMA_BENCH, ratio
        if base is not None and speed is not base:
            ratio = ratio_of_launches(values, base.by_launch(RATIO_METRIC), run.bootstrap_seed)
            if ratio:
                yield speed.name, base.name, ratio


def engine_ratios_of(run: Run, speeds: list[Speed]) -> Iterator[tuple[str, str, Ratio]]:
    """Yield cell, base and ratio of the engines' own rates: every cell that another engine answered to in-process."""
    base = _in_process(speeds)
    for speed in speeds:
        if base is not None and base.told and speed.told and speed.cell.about["engine"] != base.cell.about["engine"]:
            rates, others = speed.by_launch(ENGINE_METRIC), base.by_launch(ENGINE_METRIC)
            if ratio := ratio_of_launches(rates, others, run.bootstrap_seed):
                yield speed.name, base.name, ratio


def every_ratio_of(run: Run, speeds: list[Speed]) -> Iterator[tuple[str, str, str, Ratio]]:
    """Yield metric, cell, base and ratio."""
    yield from ((RATIO_METRIC, *found) for found in ratios_of(run, speeds))
    yield from ((ENGINE_METRIC, *found) for found in engine_ratios_of(run, speeds))


def _in_process(speeds: list[Speed]) -> Speed | None:
    return next((speed for speed in speeds if declared(speed.cell.pipeline).in_process), None)
