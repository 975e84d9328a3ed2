"""The tables of a run of chunks, its CSV and its ``--json`` object."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

from s2a_bench.experiments import Tables
from s2a_bench.experiments.cells import SHARE, plain_rows
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, METRICS, ChunkRow
from s2a_bench.policy.conformal import promise
from s2a_bench.store.manifest import present
from s2a_bench.store.schema import about
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.json import cell_of_row, frame
from s2a_bench.writers.tables import ABSENT, EMULATED, Note, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun

ChunkCell = cell_of_row(
    "ChunkCell",
    "A mode of acting on chunks under one source of latencies.",
    ChunkRow,
    without=(),
    own={
        "emulated": Annotated[bool, about("Whether latencies were given or drawn, in virtual time or by the server.")]
    },
)

Row = dict[str, Any]

_CONVENTION: Final = {
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
_MOTION: Final = ("jerk_rms", "boundary_jump_mean", "boundary_jump_p99", "action_step_mean")
_FOLLOWING: Final = ("tracking_rms", "tracking_rms_ideal", "jerk_rms", "jerk_rms_ideal", *_MOTION[1:])
_TITLES: Final = {"execution_horizon": "s", "trigger": "m", **{name: metric.title for name, metric in METRICS.items()}}
_SCALES: Final = {"s": 1e3, "bytes/s": 1e-6}
"""Unit -> factor: tables show times in ms, bytes in MB."""
_EMULATED: Final = Note(
    "EMULATED: ticks are counted in virtual time, with given latencies; nothing was measured.", EMULATED
)


def rows_of(run: StoredRun) -> list[Row]:
    """Return the rows of a run in the order of the options; a missing value is None."""
    rows, settings = plain_rows(run, CHUNKS), run.manifest["configuration"]
    order = [*((name, "given") for name in settings["modes"]), *((None, rule) for rule in settings["rules"])]

    def place(row: Row) -> tuple[str, int]:
        return row["latency"], order.index((row["mode"] if row["rule"] == "given" else None, row["rule"]))

    return sorted(rows, key=place) if live(run) else rows


def sources_of(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    names = dict.fromkeys(row["latency"] for row in rows)
    return [(name, [row for row in rows if row["latency"] == name]) for name in names]


def live(run: StoredRun) -> bool:
    return bool(run.manifest["configuration"].get("live"))


def smoothness_table(run: StoredRun) -> TextTable | None:
    """Return the table of the plant's smoothness under each mode; in virtual time, also of its tracking error."""
    if all(row.get("jerk_rms") is None for row in rows_of(run)):
        return None
    robot = run.manifest["configuration"]["robot"]
    jump = "jump: from one action to the next across a boundary, step: within a chunk."
    if live(run):
        note = f"Jerk (root mean square) of {robot}, in the actions' unit and s. {jump}"
        return _table(run, "Smoothness", _MOTION, (_convention(run), note))
    note = (
        f"Tracking error and jerk (root mean squares) of {robot}, in the target's standard deviation and s; ideal: "
        f"with a request in every tick and no latency. {jump}"
    )
    return _table(run, "Smoothness", _FOLLOWING, (_convention(run), note, _EMULATED))


def chunk_tables(run: StoredRun) -> Tables:
    return {
        "chunks": lambda: _table(run, "Stalls", _STALLS),
        "actions": lambda: _table(run, "Actions: ages in ticks", _ACTIONS),
        "delays": lambda: delay_table(run),
        "loop": lambda: _table(run, "Control loop", _LOOP, (_convention(run), _LOOP_NOTE)) if live(run) else None,
        "smoothness": lambda: smoothness_table(run),
    }


def delay_table(run: StoredRun) -> TextTable:
    """Return the table of the delays of each source; in a live run, of each mode with the d that it assumes."""
    of_modes = live(run)
    left = ("mode",) if of_modes else ("latency", "requests")
    names = ["delay_ticks_mean", "delay_ticks_p99", "delay_ticks_max"]
    names += ["delay_assumed_ticks", "p_delay_above"] if of_modes else []
    rows, cells = [], []
    for place, (_, group) in enumerate(sources_of(rows_of(run)), 1):
        for one in group if of_modes else group[:1]:
            latency = (number(one[column] * 1e3) for column in ("latency_s", "latency_s_p99"))
            about = (str(one[column]) for column in left)
            cells.append(one["cell"])
            rows.append((str(place), *about, *latency, *(_cell(one, name) for name in names)))
    header = ("L", *left, "ms", "p99", *(_TITLES[name] for name in names))
    title = f"Delays, d = {run.manifest['configuration']['rounding']} of L over Delta t"
    notes = (_convention(run), "L and d of streamed: to the first action.")
    return TextTable(title, header, rows, 2, notes=notes, cells=tuple(cells))


def chunk_csv(run: StoredRun) -> dict[str, CsvTable]:
    return {"chunks.csv": CsvTable.of_frame(run.table(CHUNKS))}


def chunk_json(run: StoredRun) -> dict[str, Any]:
    origins = run.origins
    return frame(
        run, [present(ChunkCell(**row, emulated=origins.of(row["cell"]).emulated)) for row in rows_of(run)], []
    )


def _table(run: StoredRun, title: str, names: Sequence[str], notes: Iterable[str] | None = None) -> TextTable:
    """Return a table with a line a row; with several sources the first column is a number of the table of delays."""
    found = sources_of(rows_of(run))
    several = len(found) > 1
    ruled = any(row["rule"] != "given" for row in rows_of(run))
    named = ("mode", "rule") if ruled or not live(run) else ("mode",)
    groups = [
        [
            (*(str(place),) * several, *(_named(row, name) for name in named), *(_cell(row, name) for name in names))
            for row in group
        ]
        for place, (_, group) in enumerate(found, 1)
    ]
    settings = run.manifest["configuration"]
    of = "" if several else f" @ {found[0][0]}" if found else ""
    slower = f" / {settings['slow_down']:g}" if settings.get("slow_down", 1) > 1 else ""
    what = f"{title}{of}, H = {settings['horizon']}, {settings['control_hz']:g}{slower} Hz, d by {settings['rounding']}"
    header = (*("L",) * several, *named, *(_TITLES[name] for name in names))
    cells = (row["cell"] for _, group in found for row in group)
    notes = _notes(run) if notes is None else notes
    return TextTable.grouped(what, header, groups, several + len(named), notes, cells=cells)


def _named(row: Row, column: str) -> str:
    slower = row.get("slower") or 1
    return f"{row[column]}, {slower:.3g}x slower" if column == "rule" and slower > 1 else str(row[column])


def _cell(row: Row, name: str) -> str:
    """Return one value as text: shares in percent without the sign, P(stall) with its interval."""
    value, metric = row[name], METRICS.get(name)
    if value is None:
        return ABSENT
    if metric is None:
        return entry(value)
    if metric.unit in _SCALES:
        return number(value * _SCALES[metric.unit])
    if metric.kind != SHARE:
        return entry(value)
    percent = entry(round(value * 100, 6))
    if name != "p_stall_cycle":
        return percent
    return f"{percent} [{_cell(row, 'p_stall_low')}, {_cell(row, 'p_stall_high')}]"


def entry(value: float) -> str:
    """Return a number as text, without decimals if it is whole."""
    return str(int(value)) if float(value).is_integer() else number(value)


def _convention(run: StoredRun) -> str:
    return _CONVENTION[run.manifest["configuration"]["rounding"]]


def _notes(run: StoredRun) -> Iterator[str]:
    yield _convention(run)
    yield (
        "P(stall): share of the cycles, with its 95 % interval; form: the closed form of the same sample of latencies, "
        "where it holds; margin: ticks that all latencies may be longer without a stall. Ages and stalls are in "
        "control ticks."
    )
    rows = rows_of(run)
    if any(row["slow_down"] is not None and row["slow_down"] > 1 for row in rows):
        yield "Where no trigger is enough, actions have to be slower by beta (chunks.csv: slow_down)."
    if any(row["rule"] != "given" for row in rows):
        settings = run.manifest["configuration"]
        others = "an oracle that knows the distribution. All others learnt from the same cycles."
        yield (
            f"Rules choose m of queue: calibrated for epsilon = {settings['epsilon']:g}, tracked from there, "
            f"lerobot's maximum, the mean, {'each after the same warm-up.' if live(run) else others}"
        )
        if found := run.manifest.get("calibrations"):
            yield promise(found, "the calibrated trigger", "cycles")
    if live(run):
        sources = [name for name, _ in sources_of(rows)]
        if len(sources) > 1:
            yield "; ".join(f"{place}: {name}" for place, name in enumerate(sources, 1)) + "."
        return
    yield _EMULATED
