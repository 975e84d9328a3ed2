"""The tables of a run of chunks, and its ``--json`` object."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.chunks.rows import CHUNKS
from s2a_bench.experiments.chunks.view.cell import ChunkCell
from s2a_bench.store.manifest import present
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.as_json import frame
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import ABSENT, EMULATED, Note, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

Row = dict[str, Any]

_CONVENTION: Final = {
    "floor": "d = floor(L / Delta t): an action leaves at the end of its tick, as real-time chunking counts.",
    "ceil": "d = ceil(L / Delta t): an action leaves at the start of its tick, as lerobot counts.",
}

_SMOOTHNESS: Final = {
    "tracking_rms": "tracking",
    "tracking_rms_ideal": "ideal",
    "jerk_rms": "jerk",
    "jerk_rms_ideal": "ideal",
    "boundary_jump_mean": "jump",
    "boundary_jump_p99": "p99",
    "action_step_mean": "step",
}
_OF_A_TARGET: Final = ("tracking_rms", "tracking_rms_ideal", "jerk_rms_ideal")
_EMULATED: Final = Note(
    "EMULATED: ticks are counted in virtual time, on latencies that are given; nothing was measured here.", EMULATED
)


def rows_of(run: Run) -> list[Row]:
    """Return the rows of a run; what a row lacks is None. Live they are made in random order, which is put right."""
    table = run.table(CHUNKS).drop(columns=PROVENANCE)
    whole = table.astype(object).where(table.notna(), None)
    rows = [{str(name): value for name, value in row.items()} for row in whole.to_dict("records")]
    asked = run.manifest["configuration"]
    order = [*((name, "given") for name in asked["modes"]), *((None, rule) for rule in asked["rules"])]

    def place(row: Row) -> tuple[str, int]:
        return row["latency"], order.index((row["mode"] if row["rule"] == "given" else None, row["rule"]))

    return sorted(rows, key=place) if live(run) else rows


def sources_of(rows: list[Row]) -> list[tuple[str, list[Row]]]:
    """Return the rows of each source of latencies, in the order asked for."""
    names = dict.fromkeys(row["latency"] for row in rows)
    return [(name, [row for row in rows if row["latency"] == name]) for name in names]


def stall_table(run: Run) -> TextTable:
    """Lay out how often each mode stalls, and what would have been safe."""
    header = ("s", "m", "stalls/s", "P(stall), %", "form", "longest", "margin")
    return _table(run, "Stalls", header, _stalls)


def action_table(run: Run) -> TextTable:
    """Lay out how old the actions are, how soon the robot reacts, and what is lost at boundaries."""
    header = ("age", "max", "react (ms)", "form", "p99", "Hz", "unused, %", "jump")
    return _table(run, "Actions: ages in ticks", header, _actions)


def loop_table(run: Run) -> TextTable:
    """Lay out how well the control loop of a live run kept time."""
    header = ("alike, %", "jitter (ms)", "p99", "max", "late", "busy (ms)", "max", "MB/s up")
    note = (
        "alike: share of the ticks that virtual time has the same way, on the latencies that were measured; jitter: "
        "how long after it was due an action left; late: by a tick or more; busy: for how long asking and sending kept "
        "the loop in a tick, p99."
    )
    return replace(_table(run, "Control loop", header, _loop), notes=(_convention(run), note))


def live(run: Run) -> bool:
    """Whether a run acted in real time."""
    return bool(run.manifest["configuration"].get("live"))


def smoothness_table(run: Run) -> TextTable:
    """Lay out how smoothly a plant moves under each mode; in virtual time, how well it follows a target besides."""
    names = {name: title for name, title in _SMOOTHNESS.items() if not live(run) or name not in _OF_A_TARGET}
    table = _table(run, "Smoothness", tuple(names.values()), lambda row: (_number(row[name]) for name in names))
    robot = run.manifest["configuration"]["robot"]
    jump = "jump: from one action to the next across a boundary, step: within a chunk."
    if live(run):
        note = f"Jerk (root mean square) of {robot}, in the actions' unit and s. {jump}"
        return replace(table, notes=(_convention(run), note))
    note = (
        f"Tracking error and jerk (root mean squares) of {robot}, in the target's standard deviation and s; ideal: "
        f"asked in every tick and answered at once. {jump}"
    )
    return replace(table, notes=(_convention(run), note, _EMULATED))


def chunk_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name."""
    found = {"chunks": stall_table(run), "actions": action_table(run), "delays": delay_table(run)}
    found |= {"loop": loop_table(run)} if live(run) else {}
    smooth = any(row.get("jerk_rms") is not None for row in rows_of(run))
    return found | ({"smoothness": smoothness_table(run)} if smooth else {})


def delay_table(run: Run) -> TextTable:
    """Lay out the realised delays of each source, live of each mode beside the d that it is ready for."""
    rows = []
    for place, (name, group) in enumerate(sources_of(rows_of(run)), 1):
        shared = next((row for row in group if not row["mode"].startswith("streamed")), group[0])
        for one in group if live(run) else [shared]:
            delays = (_number(one[f"delay_ticks_{part}"]) for part in ("mean", "p99", "max"))
            latency = (number(one[part] * 1e3) for part in ("latency_s", "latency_s_p99"))
            told = (_number(one["delay_assumed_ticks"]), _percent(one["p_delay_above"])) if live(run) else ()
            who = (one["mode"],) if live(run) else (name, str(one["requests"]))
            rows.append((str(place), *who, *latency, *delays, *told))
    left, more = (("L", "mode"), ("assumed", "above, %")) if live(run) else (("L", "latency", "requests"), ())
    header = (*left, "ms", "p99", "d", "p99", "max", *more)
    title = f"Delays, d = {_rounding(run)} of L over Delta t"
    return TextTable(title, header, rows, 2, notes=(_convention(run),))


def chunk_csv(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table: every metric of every row."""
    return {"chunks.csv": CsvTable.of_frame(run.table(CHUNKS))}


def chunk_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints."""
    origins = run.origins
    return frame(
        run, [present(ChunkCell(**row, emulated=origins.of(row["cell"]).emulated)) for row in rows_of(run)], []
    )


def chunk_sentences(run: Run) -> list[str]:
    """Return what calibration costs over the oracle, what the other rules do, and how a control loop kept time."""
    said = []
    epsilon = float(run.manifest["configuration"]["epsilon"])
    for name, rows in sources_of(rows_of(run)):
        by_rule = {row["rule"]: row for row in rows if row["p_stall_cycle"] is not None}
        parts = [
            f"{rule} {row['p_stall_cycle']:.2%} at age {_number(row['age_ticks_mean'])}"
            for rule, row in by_rule.items()
            if rule != "given"
        ]
        if parts:
            said.append(f"Stalled cycles of queue @ {name}, for at most {epsilon:.2%}: {', '.join(parts)} ticks.")
        if live(run):
            least, worst = min(row["agreement"] for row in rows), max(row["jitter_s_p99"] for row in rows)
            said.append(
                f"Control loop @ {name}: {least:.2%} of the ticks and more are as virtual time has them; "
                f"p99 of the jitter {number(worst * 1e3)} ms at most."
            )
        slower = max((row["slow_down"] or 1 for row in rows if row["mode"].startswith("queue")), default=1)
        if slower > 1:
            said.append(f"@ {name} no trigger of queue is enough: actions would have to be {slower:.2f} times slower.")
    return said


def _table(run: Run, title: str, header: tuple[str, ...], cells: Any) -> TextTable:
    """Lay out a line a row; of several sources the first column has the number that the table of delays names."""
    rows: list[tuple[str, ...]] = []
    rules = []
    found = sources_of(rows_of(run))
    several = len(found) > 1
    ruled = any(row["rule"] != "given" for row in rows_of(run))
    named = ("mode", "rule") if ruled or not live(run) else ("mode",)
    for place, (_, group) in enumerate(found, 1):
        rules.append(len(rows))
        rows += [((str(place),) * several + (*(_named(row, name) for name in named), *cells(row))) for row in group]
    asked = run.manifest["configuration"]
    of = "" if several else f" @ {found[0][0]}" if found else ""
    slower = f" / {asked['slow_down']:g}" if asked.get("slow_down", 1) > 1 else ""
    what = f"{title}{of}, H = {asked['horizon']}, {asked['control_hz']:g}{slower} Hz, d by {_rounding(run)}"
    left = ("L",) * several + named
    return TextTable(what, (*left, *header), rows, len(left), frozenset(rules[1:]), tuple(_notes(run)))


def _named(row: Row, column: str) -> str:
    """Return a row's mode or rule, and by how much the rule slowed actions down."""
    slower = row.get("slower") or 1
    return f"{row[column]}, {slower:.3g}x slower" if column == "rule" and slower > 1 else str(row[column])


def _stalls(row: Row) -> Iterator[str]:
    yield str(row["execution_horizon"])
    yield _number(row["trigger"])
    yield _number(row["stall_ticks_per_s"])
    yield _interval(row)
    yield _percent(row["p_stall_closed"])
    yield _number(row["longest_stall_ticks"])
    yield _number(row["margin_ticks"])


def _actions(row: Row) -> Iterator[str]:
    for name in ("age_ticks_mean", "age_ticks_max"):
        yield _number(row[name])
    for name in ("reaction_s_mean", "reaction_s_closed", "reaction_s_p99"):
        yield ABSENT if row[name] is None else number(row[name] * 1e3)
    yield _number(row["control_rate_hz"])
    yield _percent(row["thrown_away_share"])
    yield _number(row["jump_mean"])


def _loop(row: Row) -> Iterator[str]:
    yield _percent(row["agreement"])
    for name in ("jitter_s_p50", "jitter_s_p99", "jitter_s_max"):
        yield number(row[name] * 1e3)
    yield str(row["late_ticks"])
    for name in ("blocked_s_p99", "blocked_s_max"):
        yield number(row[name] * 1e3)
    yield number(row["bytes_up_per_s"] / 1e6)


def _interval(row: Row) -> str:
    if row["p_stall_cycle"] is None:
        return ABSENT
    share, low, high = (_percent(row[f"p_stall_{part}"]) for part in ("cycle", "low", "high"))
    return f"{share} [{low}, {high}]"


def _percent(value: float | None) -> str:
    """Write a share in percent, without the sign."""
    return ABSENT if value is None else _number(round(value * 100, 6))


def _number(value: float | None) -> str:
    """Write a number, a whole one without decimals."""
    if value is None:
        return ABSENT
    return str(int(value)) if float(value).is_integer() else number(value)


def _rounding(run: Run) -> str:
    return str(run.manifest["configuration"]["rounding"])


def _convention(run: Run) -> str:
    return _CONVENTION[_rounding(run)]


def _notes(run: Run) -> Iterator[str]:
    """Yield what a reader must know besides the numbers."""
    yield _convention(run)
    yield (
        "P(stall): share of the cycles, with its 95 % interval; form: what the closed form says, where it holds; "
        "margin: ticks that all latencies may be longer without a stall. Ages and stalls are in control ticks."
    )
    rows = rows_of(run)
    if any(row["mode"].startswith("streamed") for row in rows):
        yield "streamed: the latency is that of the first action, d that of the last."
    if any(row["slow_down"] is not None and row["slow_down"] > 1 for row in rows):
        yield "Where no trigger is enough, actions have to be slower by beta (chunks.csv: slow_down)."
    if any(row["rule"] != "given" for row in rows):
        asked = run.manifest["configuration"]
        seen = "an oracle that knows the distribution. All others saw the same cycles before."
        yield (
            f"Rules choose m of queue: calibrated for P(stall) <= {asked['epsilon']:.2%}, tracked from there, "
            f"lerobot's maximum, the mean, {'each after the same warm-up.' if live(run) else seen}"
        )
    if live(run):
        sources = [name for name, _ in sources_of(rows)]
        if len(sources) > 1:
            yield "; ".join(f"{place}: {name}" for place, name in enumerate(sources, 1)) + "."
        return
    yield _EMULATED
