"""What throughput runs are compared by: rates, times and counts of a request, and what its tokens show."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments import Compared, Metric, Subject, by_name
from s2a_bench.experiments.latency.view.compared import TOKEN_METRICS, origin_of, singles, subject_of, token_rows
from s2a_bench.experiments.throughput.view.cells import Speed, speeds_by_launch

if TYPE_CHECKING:
    from s2a_bench.experiments import Rows
    from s2a_bench.store.run import Run


def _subjects(run: Run) -> list[Subject]:
    return [
        subject_of(speed.cell, partial(_rows, speed), launch)
        for launch, speeds in speeds_by_launch(run)
        for speed in speeds
    ]


def _rows(speed: Speed, name: str) -> Rows:
    """Return the rows of a metric of requests, or the gaps between tokens."""
    found = token_rows(speed.cell, name)
    return singles(speed.values(name)) if found is None else found


COMPARED: Final = Compared(
    metrics=by_name(
        [
            Metric("tokens_per_s", "tokens/s", "higher"),
            Metric("decode_tokens_per_s", "tokens/s", "higher"),
            Metric("ttft_ms", "ms"),
            Metric("prompt_ms", "ms"),
            *(Metric(part, "ms") for part in ("preprocess_ms", "vision_encode_ms", "image_ms", "prompt_eval_ms")),
            Metric("first_decode_ms", "ms"),
            Metric("prompt_tokens", "tokens", "neither"),
            Metric("prefill_tokens_per_s", "tokens/s", "higher"),
            Metric("tokens_per_joule", "tokens/J", "higher"),
            *TOKEN_METRICS,
        ]
    ),
    subjects=_subjects,
    origin=origin_of,
    shown=("tokens_per_s", "decode_tokens_per_s", "ttft_ms", "prefill_tokens_per_s", "itl"),
)
