"""The machine's view of a CCRB run: the ``--json`` object; SI units, float seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.view.outcomes import has, law_of, rate_span, rollouts_of, scenes_of, share_of
from s2a_bench.experiments.ccrb.view.tables import ORDERINGS
from s2a_bench.plan.skillset import GAPS
from s2a_bench.writers.as_json import frame

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

_TIMES = ("start", "end", "stall", "deadline")


def ccrb_to_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints, as docs/schema/s2a-bench-1.json describes it.

    A cell a policy at the operating point; studies are summed up as shares, their roll-outs are in the run folder.
    """
    cells = [_cell(row) for row in rollouts_of(run, "point").to_dict("records")]
    studies = [_study(run, study, gap) for study in ("phase", "random") if has(run, study) for gap in GAPS]
    live = {"live": run.manifest["live"]} if "live" in run.manifest else {}
    return frame(run, cells, [], **live, follower_law=law_of(run), studies=studies)


def _cell(row: dict[Any, Any]) -> dict[str, Any]:
    """Return one roll-out; what it does not have is an absent key."""
    import pandas as pd

    plain = {str(name): value for name, value in row.items() if not pd.isna(value)}
    for name in ("study", "draw", "title"):
        plain.pop(name, None)
    for name in _TIMES:
        plain[f"{name}_s"] = plain.pop(f"{name}_ns") / 1e9
    plain["rate_tokens_per_s"] = plain.pop("tokens_per_s")
    plain["profile"] = plain.pop("board") or None
    return plain


def _study(run: Run, study: str, gap: str) -> dict[str, Any]:
    """Return the shares of one study under one gap behaviour."""
    scenes = scenes_of(run, study, gap)
    shares = {}
    for name in ORDERINGS:
        share = share_of(scenes, name)
        interval = {"ci95": list(share.interval)} if study == "random" else {}
        shares[name] = {"k": share.k, "value": share.value, **interval}
    span = rate_span(run, gap) if study == "phase" else None
    rates = {} if span is None else {"paper_rates_tokens_per_s": list(span)}
    return {"study": study, "gap_behaviour": gap, "scenarios": len(scenes), "orderings": shares, **rates}
