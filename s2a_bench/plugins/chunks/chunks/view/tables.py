"""The tables of a run of chunks, its CSV and its ``--json`` object."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from s2a_bench.experiments import Tables
from s2a_bench.experiments.cells import SHARE, Cells
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, METRICS, ChunkRow
from s2a_bench.policy.conformal import promise
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.tables import ABSENT, EMULATED, Note, TextTable, number

CONVENTION: Final = {
    "floor": "d = floor(L / Delta t): an action leaves at the end of its tick, as real-time chunking counts.",
    "ceil": "d = ceil(L / Delta t): an action leaves at the start of its tick, as lerobot counts.",
}

_STALLS: Final = (
    *("execution_horizon", "trigger", "stall_ticks_per_s", "p_stall_cycle", "p_stall_closed", "longest_stall_ticks"),
    "margin_ticks",
)
_ACTIONS: Final = (
    *("age_ticks_mean", "age_ticks_max", "reaction_s_mean", "reaction_s_closed", "reaction_s_p99", "control_rate_hz"),
    *("thrown_away_share", "jump_mean"),
)
_LOOP: Final = (
    *("agreement", "jitter_s_p50", "jitter_s_p99", "jitter_s_max", "late_ticks", "blocked_s_p99", "blocked_s_max"),
    "bytes_up_per_s",
)
_LOOP_NOTE: Final = (
    "alike: share of the ticks with the chunk, action and age that the mode's arrays give for the measured delays, "
    "empty where they do not cover the arrivals; jitter: delay of an action after its due time; late: by a tick or "
    "more; busy: time of a tick spent on requests and sending, p99."
)
_TITLES: Final = {"execution_horizon": "s", "trigger": "m", **{name: metric.title for name, metric in METRICS.items()}}
_SCALES: Final = {"s": 1e3, "bytes/s": 1e-6}
"""Unit -> factor: tables show times in ms, bytes in MB."""
_EMULATED: Final = Note(
    "EMULATED: ticks of virtual time, with the latencies of each row; no loop was measured.",
    EMULATED,
)


@dataclass(frozen=True, slots=True)
class ChunkCells:
    """The rows of a run in the order of its options, and its configuration."""

    rows: list[ChunkRow]
    settings: dict[str, Any]
    calibrations: dict[str, Any]
    """What the rule `calibrated` learned, by source."""

    @classmethod
    def of(cls, run: StoredRun) -> ChunkCells:
        cells = cls(Cells.of(run, CHUNKS).rows, run.manifest["configuration"], run.manifest.get("calibrations", {}))
        return replace(cells, rows=sorted(cells.rows, key=cells._place)) if cells.live else cells

    def _place(self, row: ChunkRow) -> tuple[str, int]:
        modes, rules = self.settings["modes"], self.settings["rules"]
        place = list(modes).index(row.mode) if row.rule == "given" else len(modes) + list(rules).index(row.rule)
        return row.latency, place

    @property
    def live(self) -> bool:
        return bool(self.settings.get("live"))

    @property
    def ruled(self) -> bool:
        """Whether a rule chose triggers."""
        return any(row.rule != "given" for row in self.rows)

    @property
    def sources(self) -> dict[str, list[ChunkRow]]:
        """The rows by their source of latencies."""
        names = dict.fromkeys(row.latency for row in self.rows)
        return {name: [row for row in self.rows if row.latency == name] for name in names}

    @property
    def convention(self) -> str:
        return CONVENTION[self.settings["rounding"]]


def chunk_tables(cells: ChunkCells) -> Tables:
    loop_notes = (cells.convention, _LOOP_NOTE)
    return {
        "chunks": lambda: _table(cells, "Stalls", _STALLS),
        "actions": lambda: _table(cells, "Actions: ages in ticks", _ACTIONS),
        "delays": lambda: delay_table(cells),
        "loop": lambda: _table(cells, "Control loop", _LOOP, loop_notes) if cells.live else None,
    }


def delay_table(cells: ChunkCells) -> TextTable:
    """Return the table of the delays of each source; in a live run, of each mode with the d that it assumes."""
    left = ["mode"] if cells.live else ["latency", "requests"]
    names = ["delay_ticks_mean", "delay_ticks_p99", "delay_ticks_max"]
    names += ["delay_assumed_ticks", "p_delay_above"] if cells.live else []
    rows, named = [], []
    for place, group in enumerate(cells.sources.values(), 1):
        for row in group if cells.live else group[:1]:
            about = (str(getattr(row, column)) for column in left)
            latency = (number(row.latency_s, 1e3), number(row.latency_s_p99, 1e3))
            named.append(row.cell)
            rows.append((str(place), *about, *latency, *(_entry(row, name) for name in names)))
    header = ("L", *left, "ms", "p99", *(_TITLES[name] for name in names))
    title = f"Delays, d = {cells.settings['rounding']} of L over Delta t"
    notes = (cells.convention, "L and d of streamed: to the first action.")
    return TextTable(title, header, rows, 2, notes=notes, cells=tuple(named))


def _table(cells: ChunkCells, title: str, names: Sequence[str], notes: Iterable[str] | None = None) -> TextTable:
    """Return a table with a line a row; with several sources the first column is a number of the table of delays."""
    sources, settings = cells.sources, cells.settings
    left = ["mode", "rule"] if cells.ruled or not cells.live else ["mode"]
    groups = []
    for place, group in enumerate(sources.values(), 1):
        numbered = [str(place)] if len(sources) > 1 else []
        groups.append(
            [
                (*numbered, *(_about(row, name) for name in left), *(_entry(row, name) for name in names))
                for row in group
            ]
        )
    if len(sources) > 1:
        left = ["L", *left]
    of = f" @ {next(iter(sources))}" if len(sources) == 1 else ""
    slower = f" / {settings['slow_down']:g}" if settings.get("slow_down", 1) > 1 else ""
    what = f"{title}{of}, H = {settings['horizon']}, {settings['control_hz']:g}{slower} Hz, d by {settings['rounding']}"
    header = (*left, *(_TITLES[name] for name in names))
    named = (row.cell for group in sources.values() for row in group)
    return TextTable.grouped(what, header, groups, len(left), _notes(cells) if notes is None else notes, cells=named)


def _about(row: ChunkRow, column: str) -> str:
    slower = row.slower or 1
    text = str(getattr(row, column))
    return f"{text}, {slower:.3g}x slower" if column == "rule" and slower > 1 else text


def _entry(row: ChunkRow, name: str) -> str:
    """Return one value as text: shares in percent without the sign, P(stall) with its interval."""
    value, metric = getattr(row, name), METRICS.get(name)
    if metric is None or value is None:
        return entry(value)
    if metric.unit in _SCALES:
        return number(value * _SCALES[metric.unit])
    if metric.kind != SHARE:
        return entry(value)
    percent = entry(round(value * 100, 6))
    if name != "p_stall_cycle":
        return percent
    return f"{percent} [{_entry(row, 'p_stall_low')}, {_entry(row, 'p_stall_high')}]"


def entry(value: float | None) -> str:
    """Return a number as text, without decimals if it is whole."""
    if value is None:
        return ABSENT
    return str(int(value)) if float(value).is_integer() else number(value)


def _notes(cells: ChunkCells) -> Iterator[str]:
    yield cells.convention
    yield (
        "P(stall): share of the cycles, with its 95 % interval; form: the closed form of the same sample of latencies, "
        "where it holds; margin: ticks that all latencies may be longer without a stall. Ages and stalls are in "
        "control ticks."
    )
    if any((row.slow_down or 1) > 1 for row in cells.rows):
        yield "Where no trigger is enough, actions have to be slower by beta (chunks.csv: slow_down)."
    if cells.ruled:
        others = "an oracle that knows the distribution. All others learnt from the same cycles."
        yield (
            f"Rules choose m of queue: calibrated for epsilon = {cells.settings['epsilon']:g}, tracked from there, "
            f"lerobot's maximum, the mean, {'each after the same warm-up.' if cells.live else others}"
        )
        if cells.calibrations:
            yield promise(cells.calibrations, "the calibrated trigger", "cycles")
    if not cells.live:
        yield _EMULATED
    elif len(cells.sources) > 1:
        yield "; ".join(f"{place}: {name}" for place, name in enumerate(cells.sources, 1)) + "."
