"""The machine's view of a timeline run: the ``--json`` object; times in s, since plans take seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.timeline.metrics import METRICS
from s2a_bench.experiments.timeline.view.cells import Timelines, timelines_of
from s2a_bench.writers.as_json import frame

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

_ABOUT = ("cell", "policy", "tokens_per_s", "prompt_s", "tokens_per_skill", "n_skills", "t_nom_s", "mode", "emulated")


def timelines_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints, as docs/schema/s2a-bench-1.json describes it."""
    executed = {name: run.manifest[name] for name in ("live", "start_jitter") if run.manifest.get(name)}
    return frame(run, [_cell(cell) for cell in timelines_of(run)], [], **executed)


def _cell(cell: Timelines) -> dict[str, Any]:
    """Return one cell: means over its plans; a metric that no plan has is an absent key."""
    about = {name: cell.about(name) for name in _ABOUT}
    about["rate_tokens_per_s"] = about.pop("tokens_per_s")
    if about["prompt_s"] is None:
        del about["prompt_s"]
    means = {name: cell.mean(name) for name in METRICS}
    caution = cell.about("caution")
    return {
        **about,
        "profile": cell.about("board") or None,
        "plans": cell.n,
        **({} if caution is None else {"caution": caution}),
        **{name: mean for name, mean in means.items() if mean is not None},
    }
