"""Null experiment: e2e without model of the same requests, by our marks and as of a llama-server.

``python -m benchmarks.same_work [--requests N]``. Our engine answers behind our HTTP as deployed. From inside, e2e
without model is what the marks leave beside the model; from outside, for a server that reports its times, it is e2e
less the time that the engine reports for its prompt. What differs is what a black box hides: changing threads, choosing
the first token.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import s2a_bench as s2a
from s2a_bench.facts import PREPROCESS_MS, PROMPT_MS

if TYPE_CHECKING:
    from numpy.typing import NDArray

REQUESTS = 50


def both(output: Path, requests: int = REQUESTS, **options: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return e2e without model in ms of every request, from inside and from outside."""
    settings = {"transports": ["http/as-deployed"], "payload": "jpeg", "engine": "llama", "requests": requests}
    run = s2a.latency(**settings | options, output=output)
    good = run.samples[run.samples["error"] == ""]
    facts = [json.loads(str(row)) for row in good["facts"]]
    model_ms = np.array([row[PROMPT_MS] - row[PREPROCESS_MS] for row in facts])
    inside, e2e = (good[f"{name}_ns"].to_numpy(dtype=float) / 1e6 for name in ("e2e_without_model", "e2e"))
    return inside, e2e - model_ms


def main() -> None:
    """Print medians and differences in ms."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=REQUESTS, help="requests")
    with tempfile.TemporaryDirectory() as folder:
        inside, outside = both(Path(folder), parser.parse_args().requests)
    least, hidden = np.percentile(outside - inside, [10, 50])
    print(f"e2e without model, n = {inside.size}, medians in ms")
    print(f"{np.median(inside):9.3f}  by our marks")
    print(f"{np.median(outside):9.3f}  e2e less the engine's own time for its prompt")
    print(f"{hidden:9.3f}  between them in a request ({least:.3f} in the least disturbed tenth)")


if __name__ == "__main__":
    main()
