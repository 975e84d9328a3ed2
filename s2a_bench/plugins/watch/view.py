"""What a watch shows: where a cycle's time goes, what travels, when the robot must have run dry; a strip of cycles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import pandas as pd

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells, metrics_of
from s2a_bench.plugins.watch.rows import EXCHANGES, ExchangeRow
from s2a_bench.writers.figures import name_rows, new_figure
from s2a_bench.writers.json import frame
from s2a_bench.writers.style import GROUP_FILLS, STALL_STYLE, WIDE_IN
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

Exchanges: TypeAlias = Mapping[str, Cells[ExchangeRow]]
"""Kind of exchange -> its rows."""
PARTS: Final = {
    "upload": GROUP_FILLS["network"],
    "server": ("#BBBBBB", ""),
    "inference": GROUP_FILLS["inference"],
    "download": GROUP_FILLS["return"],
    "think": ("#F0E442", ".."),
}
"""Parts of a cycle -> colour and hatch."""
TRAVELS: Final = ("up_bytes", "down_bytes", "pieces", "horizon", "dim")
CYCLES: Final = 8
"""Exchanges of a client in the strip."""
MOST_LANES: Final = 12
SEEN: Final = "Seen between the two: what the client does before its request and after the answer is in think."

AT_LEAST: Final = "That is a lower bound: a robot that drops actions, or starts them late, is dry more often."


def show(run: StoredRun, **_: Any) -> Shown:
    exchanges = Cells.of(run, EXCHANGES)
    cells: Exchanges = exchanges.split()
    hz = run.manifest["configuration"].get("control_hz")
    return Shown.build(
        sentences=lambda: list(sentences(cells, run.manifest)),
        tables={"watch": lambda: cycle_table(cells), "sent": lambda: exchanges.table("What travels, medians", TRAVELS)},
        main=["watch", "sent"],
        csvs=lambda: {"exchanges.csv": exchanges.csv()},
        figures=lambda: {"cycles": lambda: build_cycles(cells, dry=bool(hz))},
        json=lambda: frame(run, [{**each, "errors": failed(cells[each["cell"]])} for each in exchanges.json()], []),
    )


def failed(cell: Cells[ExchangeRow]) -> int:
    return int((cell.frame["error"] != "").sum())


def sentences(cells: Exchanges, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield what each kind of exchange sends, how often the robot ran dry, and what was counted besides."""
    hz = manifest["configuration"].get("control_hz")
    for name, cell in cells.items():
        if sends := manifest.get("sends", {}).get(name):
            yield f"{name} sends {sends}."
        dry_s, horizon = cell.values("dry_s"), cell.values("horizon")
        if hz and dry_s.size:
            dry = dry_s[dry_s > 0]
            lasts = f"{name}: {horizon.max():g} actions last {horizon.max() / hz * 1e3:g} ms at {hz:g} Hz"
            longest = f", for up to {dry.max() * 1e3:.0f} ms" if dry.size else ""
            yield f"{lasts}; none can have been left before {dry.size} of {dry_s.size} answers{longest}. {AT_LEAST}"
    for what in ("tap", "topics"):
        counted = [f"{name} {value}" for name, value in manifest.get(what, {}).items() if value]
        if counted:
            yield f"{what.capitalize()}: {', '.join(counted).replace('_', ' ')}."


def cycle_table(cells: Exchanges) -> TextTable:
    """Return medians of a cycle and of its parts, in ms."""
    metrics = metrics_of(ExchangeRow)
    names = [f"{part}_s" for part in ("period", *PARTS)]
    shown = [name for name in names if any(cell.values(name).size for cell in cells.values())]
    rows = [
        (name, str(len(cell)), str(failed(cell)), *(_ms(cell, each) for each in shown), _ms(cell, "age_s", "p99"))
        for name, cell in cells.items()
    ]
    header = ("exchange", "n", "failed", *(f"{metrics[name].title} (ms)" for name in shown), "age p99 (ms)")
    return TextTable("Where a cycle's time goes, medians", header, rows, 1, notes=(SEEN,), cells=tuple(cells))


def _ms(cell: Cells[ExchangeRow], name: str, statistic: str = "median") -> str:
    summary = cell.summary(name)
    return ABSENT if summary is None else number(getattr(summary, statistic) * 1e3)


def build_cycles(cells: Exchanges, *, dry: bool) -> Figure:
    """Draw cycles of each client one after the other: the parts of each exchange, and the robot's dry times below."""
    lanes: dict[str, pd.DataFrame] = {}
    for name, cell in cells.items():
        clients = cell.split("client")
        for client, rows in clients.items():
            lanes[f"{name}\nclient {client}" if len(clients) > 1 else name] = rows.frame
    names = [*lanes][:MOST_LANES]
    figure = new_figure(0.9 + 0.42 * len(names), ("Cycles of the robot", SEEN), WIDE_IN)
    axes = figure.subplots()
    for place, name in enumerate(names):
        middle = max(0, len(lanes[name]) // 2 - CYCLES // 2)
        _draw_lane(axes, place, lanes[name][middle : middle + CYCLES])
    name_rows(axes, names)
    axes.set_xlabel("time (ms)")
    for part, (colour, hatch) in PARTS.items():
        axes.barh([-9], [0], color=colour, hatch=hatch, edgecolor="white", linewidth=0, label=part)
    if dry:
        axes.barh([-9], [0], label="dry, at least", **STALL_STYLE)
    figure.legend(loc="outside lower center", ncols=6)
    return figure


def _draw_lane(axes: Axes, place: int, rows: pd.DataFrame) -> None:
    zero_ns = rows["request_ns"].min()
    for row in rows.to_dict("records"):
        spent = {part: 0.0 if pd.isna(row[f"{part}_ns"]) else row[f"{part}_ns"] / 1e6 for part in (*PARTS, "dry")}
        asked_ms = at_ms = (row["request_ns"] - zero_ns) / 1e6
        answered_ms = asked_ms + spent["upload"] + spent["server"] + spent["inference"]
        for part, (colour, hatch) in PARTS.items():
            start_ms = asked_ms - spent[part] if part == "think" else at_ms
            at_ms = start_ms + spent[part]
            if spent[part] and start_ms >= 0:
                look: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0}
                axes.barh([place], [spent[part]], left=[start_ms], height=0.4, **look)
        if spent["dry"]:
            axes.barh([place + 0.32], [spent["dry"]], left=[answered_ms - spent["dry"]], height=0.16, **STALL_STYLE)
