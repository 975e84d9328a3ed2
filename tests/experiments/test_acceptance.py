"""What the transports may cost at most, as ratios within one interleaved run of the echo engine.

The limits are those of the project's issue on the main job; measured ratios lie at 35 to 75 % of them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from s2a_bench.store.run import read_run

LIMITS = {
    "raw": {"http/as-deployed": 70, "http/best-effort": 18, "http/binary": 12, "ros/topic": 7},
    "jpeg": {"http/as-deployed": 32, "http/best-effort": 18},
    "alone": {"iceoryx2": 5},
    "actions": {"websocket/openpi": 8},
}
"""Payload -> cell -> most times loopback's end to end without inference, at 640x480, of the quickest requests.

ROS sends raw pixels beside JPEG too, and is judged where its caches are not cold from coding. Binary with JPEG is left
to `make bench` to print: coding and decoding the JPEG alone is half of its limit of 12, and at 10.3 to 10.9 measured a
busy machine would decide the test. "alone" is raw pixels without the pipelines of other servers, which leave cold
caches behind, and one token: where the other cores are busy a server that goes on to write 31 more at once, as no model
does, keeps its client from the core for 0.15 ms, a third of what this wire costs. It takes 2.0 to 2.3 times loopback on
a quiet machine of two cores. "actions" is raw pixels and chunks of 16 actions.
"""


TRIES = 8
"""What else the machine does only adds, and to pipelines of several processes most: the best of all tries counts."""


def measured(payload: str, output: Path) -> tuple[pd.Series[float], list[str]]:
    """Return what each cell's quickest request took in ms, and the cells whose stages leave over 5 %."""
    own = {
        "jpeg": "http?payload=jpeg,loopback",
        "alone": "iceoryx2?payload=raw,loopback",
        "actions": "websocket?payload=raw,loopback",
    }
    transports = own.get(payload, f"http?payload={payload},ros,loopback")
    arguments = ["latency", "--engine", "echo", "--transport", transports]
    arguments += ["--max-tokens", "1"] * (payload == "alone")
    done = subprocess.run(
        [sys.executable, "-m", "s2a_bench", *arguments, "--requests", "100", "--json", "--output", str(output)],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    whole: dict[str, Any] = json.loads(done.stdout)
    samples = read_run(Path(whole["run"])).samples
    samples = samples[~samples["warmup"]]
    names = samples["cell"].str.partition("?")[0]
    spent_ms = (samples["e2e_ns"] - samples["inference_ns"]).groupby(names).min() / 1e6
    return spent_ms, [cell["cell"] for cell in whole["cells"] if cell["residual_share"]["median"] > 0.05]


@pytest.mark.slow
@pytest.mark.parametrize("payload", [*LIMITS])
def test_no_pipeline_is_a_straw_man_and_the_budget_closes(tmp_path: Path, payload: str) -> None:
    limits = pd.Series(LIMITS[payload])
    tries: list[pd.Series[float]] = []
    open_budgets: set[str] | None = None
    for _ in range(TRIES):
        spent_ms, left_over = measured(payload, tmp_path)
        tries.append(spent_ms)
        open_budgets = {*left_over} if open_budgets is None else open_budgets & {*left_over}
        best_ms = pd.concat(tries, axis=1).min(axis=1)
        ratios = best_ms[limits.index] / best_ms["loopback"]
        if (ratios <= limits).all() and not open_budgets:
            return
    raise AssertionError(f"{ratios.to_dict()} times loopback; stages leave over 5 % of {open_budgets}")
