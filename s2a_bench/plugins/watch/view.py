"""What a watch shows: where a cycle's time goes, what travels, when the robot must have run dry; a strip of cycles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells, metrics_of
from s2a_bench.plugins.watch.rows import EXCHANGES, ExchangeRow
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.json import frame
from s2a_bench.writers.style import GROUP_FILLS, STALL_STYLE, WIDE_IN
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

PARTS: Final = ("upload_s", "server_s", "inference_s", "download_s", "think_s")
"""Metrics that add up to a period."""
FILLS: Final = {
    "upload_s": GROUP_FILLS["network"],
    "server_s": ("#BBBBBB", ""),
    "inference_s": GROUP_FILLS["inference"],
    "download_s": GROUP_FILLS["return"],
    "think_s": ("#F0E442", "...."),
}
CYCLES: Final = 8
"""Exchanges of a client in the strip."""
MOST_LANES: Final = 12
SEEN: Final = (
    "Seen between the two: what the client does before its first byte and after the answer's last one is in think."
)


def show(run: StoredRun, **_: Any) -> Shown:
    exchanges = Cells.of(run, EXCHANGES)
    cells: dict[str, Cells[ExchangeRow]] = exchanges.split()
    hz, sends = run.manifest["configuration"].get("control_hz"), run.manifest.get("sends", {})
    return Shown.build(
        sentences=lambda: [*sentences(cells, sends, hz), *totals(run.manifest.get("tap", {}))],
        tables={
            "watch": lambda: cycle_table(cells),
            "sent": lambda: sent_table(cells, sends),
            "dry": lambda: dry_table(cells, hz) if hz else None,
        },
        main=["watch", "sent", "dry"],
        csvs=lambda: {"exchanges.csv": exchanges.csv()},
        figures=lambda: {"cycles": lambda: build_cycles(cells, hz)},
        json=lambda: frame(run, [cell | _counts(cells[cell["cell"]]) for cell in exchanges.json()], []),
    )


def _counts(cell: Cells[ExchangeRow]) -> dict[str, Any]:
    return {"errors": failed(cell), "clients": int(cell.frame["client"].nunique())}


def failed(cell: Cells[ExchangeRow]) -> int:
    return int((cell.frame["error"] != "").sum())


def sentences(cells: dict[str, Cells[ExchangeRow]], sends: dict[str, str], hz: float | None) -> Iterator[str]:
    """Yield what each kind of exchange sends, and how often the robot ran dry."""
    for name, cell in cells.items():
        if sends.get(name):
            yield f"{name} sends {sends[name]}."
        dry_s = cell.values("dry_s")
        if hz and dry_s.size:
            yield (
                f"{name}: at {hz:g} Hz no action can have been left before {int((dry_s > 0).sum())} of {dry_s.size} "
                f"answers, for up to {dry_s.max() * 1e3:.0f} ms; with actions dropped or late it is more."
            )


def totals(tap: dict[str, int]) -> Iterator[str]:
    if tap:
        odd = {
            "unreachable": "without the server",
            "unread": "read by who speaks",
            "reconnects": "in place of others",
            "lost": "exchanges lost",
        }
        said = [f"{tap[name]} {words}" for name, words in odd.items() if tap.get(name)]
        of_them = f", of them {', '.join(said)}" if said else ""
        yield f"Connections: {tap['connections']}{of_them}; pings: {tap['pings']}."


def cycle_table(cells: dict[str, Cells[ExchangeRow]]) -> TextTable:
    """Return medians of a cycle and of its parts, in ms."""
    shown = [name for name in ("period_s", *PARTS) if any(cell.values(name).size for cell in cells.values())]
    metrics = metrics_of(ExchangeRow)
    rows = []
    for name, cell in cells.items():
        medians = (_ms(cell, each, "median") for each in shown)
        rows.append((name, str(len(cell)), str(failed(cell)), *medians, _ms(cell, "age_s", "p99")))
    header = ("exchange", "n", "failed", *(f"{metrics[name].title} (ms)" for name in shown), "age p99 (ms)")
    return TextTable("Where a cycle's time goes, medians", header, rows, 1, notes=(SEEN,), cells=tuple(cells))


def sent_table(cells: dict[str, Cells[ExchangeRow]], sends: dict[str, str]) -> TextTable:
    rows = [
        (
            name,
            sends.get(name, ABSENT),
            *(_kb(cell, each) for each in ("up_bytes", "down_bytes")),
            *(_plain(cell, each) for each in ("pieces", "horizon", "dim")),
            _rate(cell),
        )
        for name, cell in cells.items()
    ]
    header = ("exchange", "sends", "up (kB)", "down (kB)", "pieces", "H", "D", "actions/s")
    notes = ("Medians. H, D: actions of a chunk, and numbers of each; actions/s: those that arrive in a second.",)
    return TextTable("What travels", header, rows, 2, notes=notes, cells=tuple(cells))


def dry_table(cells: dict[str, Cells[ExchangeRow]], hz: float) -> TextTable:
    rows = []
    for name, cell in cells.items():
        dry_s, horizon = cell.values("dry_s"), cell.values("horizon")
        if dry_s.size:
            lasts_ms = float(np.median(horizon)) / hz * 1e3
            values = (lasts_ms, float((dry_s > 0).mean() * 100), dry_s.max() * 1e3, dry_s.sum())
            rows.append((name, str(dry_s.size), *map(number, values)))
    header = ("exchange", "n", "H lasts (ms)", "dry, at least (%)", "longest (ms)", "together (s)")
    note = (
        f"Dry: at {hz:g} actions a second no action can have been left before the answer, even if none was ever "
        "dropped and each could act at once. A lower bound: a robot that drops late actions is dry more often."
    )
    return TextTable("Cycles in which the robot must have run dry", header, rows, 1, notes=(note,))


def _ms(cell: Cells[ExchangeRow], name: str, statistic: str) -> str:
    summary = cell.summary(name)
    return ABSENT if summary is None else number(getattr(summary, statistic) * 1e3)


def _kb(cell: Cells[ExchangeRow], name: str) -> str:
    summary = cell.summary(name)
    return ABSENT if summary is None else number(summary.median / 1e3)


def _plain(cell: Cells[ExchangeRow], name: str) -> str:
    summary = cell.summary(name)
    return ABSENT if summary is None or not summary.median else f"{summary.median:g}"


def _rate(cell: Cells[ExchangeRow]) -> str:
    horizon, asked = cell.values("horizon"), cell.frame["asked_ns"]
    spent_s = (asked.max() - asked.min()) / 1e9
    return number(horizon[1:].sum() / spent_s) if len(horizon) > 1 and spent_s > 0 else ABSENT


def build_cycles(cells: dict[str, Cells[ExchangeRow]], hz: float | None) -> Figure:
    """Draw cycles of each client one after the other: the parts of each exchange, and the robot's dry times below."""
    lanes = [
        (f"{name}\nclient {client}" if len(of_cell) > 1 else name, rows)
        for name, cell in cells.items()
        for of_cell in [cell.split("client")]
        for client, rows in of_cell.items()
    ][:MOST_LANES]
    figure = new_figure(0.9 + 0.42 * len(lanes), ("Cycles of the robot", SEEN), WIDE_IN)
    axes = figure.subplots()
    for place, (_, rows) in enumerate(lanes):
        middle = max(0, len(rows) // 2 - CYCLES // 2)
        _draw_lane(axes, place, rows.frame[middle : middle + CYCLES])
    axes.set_yticks(range(len(lanes)), [name for name, _ in lanes])
    axes.set(xlabel="time (ms)", ylim=(len(lanes) - 0.4, -0.6))
    axes.tick_params(axis="y", length=0)
    present = [part for part in PARTS if any(cell.values(part).size for cell in cells.values())]
    for part in present:
        colour, hatch = FILLS[part]
        axes.barh([-9], [0], color=colour, hatch=hatch, edgecolor="white", linewidth=0, label=part.removesuffix("_s"))
    if hz:
        axes.barh([-9], [0], label="dry, at least", **STALL_STYLE)
    figure.legend(loc="outside lower center", ncols=6)
    return figure


def _draw_lane(axes: Any, place: int, rows: Any) -> None:
    zero_ns = rows["asked_ns"].min()
    for row in rows.to_dict("records"):
        at_ms = (row["asked_ns"] - zero_ns) / 1e6
        before_ms = _milliseconds(row["think_ns"])
        spans = [("think_s", at_ms - before_ms, before_ms)]
        for part in PARTS[:-1]:
            spent_ms = _milliseconds(row[f"{part.removesuffix('_s')}_ns"])
            spans.append((part, at_ms, spent_ms))
            at_ms += spent_ms
            if part == "inference_s":
                answer_ms = at_ms
        for part, start_ms, spent_ms in spans:
            if spent_ms and start_ms >= 0:
                colour, hatch = FILLS[part]
                style = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0}
                axes.barh([place], [spent_ms], left=[start_ms], height=0.4, **style)
        if dry_ms := _milliseconds(row["dry_ns"]):
            axes.barh([place + 0.32], [dry_ms], left=[answer_ms - dry_ms], height=0.16, **STALL_STYLE)


def _milliseconds(value: Any) -> float:
    return 0.0 if pd.isna(value) else value / 1e6
