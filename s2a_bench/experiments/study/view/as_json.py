"""The machine's view of a study: the ``--json`` object; times in s, regrets and shares as fractions."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.study.rows import STUDIES
from s2a_bench.experiments.study.view.tables import ONLINE, targets
from s2a_bench.writers.as_json import frame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from s2a_bench.store.run import Run

JUDGED = "targets"
"""The study that has limits to keep."""


def study_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints, as docs/schema/s2a-bench-1.json describes it."""
    rows = run.table(STUDIES)
    online = rows[rows["policy"] == ONLINE]
    more: dict[str, Any] = {}
    if run.manifest["configuration"]["study"] == JUDGED:
        more["targets"] = [{**asdict(each), "met": each.met} for each in targets(online)]
    return frame(run, list(_cells(run)), [], **more)


def _cells(run: Run) -> Iterator[dict[str, Any]]:
    """Yield a cell a row; what a row does not have is an absent key."""
    import pandas as pd

    for row in run.table(STUDIES).to_dict("records"):
        row["rate_tokens_per_s"] = row.pop("tokens_per_s")
        yield {str(name): value for name, value in row.items() if not pd.isna(value)} | {"emulated": True}
