"""Timelines as they are executed: growing lanes on a terminal, else a line a policy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.console import Group
from rich.text import Text

from s2a_bench.act.record import Record
from s2a_bench.clock import now_ns
from s2a_bench.policy import TOLERANCE_S

STATUS = 21
LEAST_LANE = 20
NARROW = 90
"""Terminals with fewer columns get short texts beside the lanes."""
COLOURS = ("blue", "yellow", "green", "cyan", "magenta")
WAITING, SKILL, STALL, TOKEN, COMPLETE, NOW, SAFE = "─█╱·┃│┊"  # noqa: RUF001 - a hatch, not a slash


@dataclass(frozen=True, slots=True)
class Scene:
    """A view of records that grow."""

    title: str
    records: Sequence[Record]
    n_skills: int
    span_s: float

    def draw(self, width: int) -> Group:
        return draw(self, now_ns(), width)

    def lines(self) -> Iterator[str]:
        return (f"  {record.policy}: {summary(record)}" for record in self.records)


def draw(scene: Scene, at_ns: int, width: int) -> Group:
    """Draw a scene at a time, ``width`` columns wide: tokens, a lane a policy, and the time axis."""
    names = max(len(record.policy) for record in scene.records)
    status = STATUS if width >= NARROW else STATUS - 9
    first = scene.records[0]
    now_s = (at_ns - first.requested_ns) / 1e9 if first.requested_ns is not None else 0.0
    over = all(record.outcome for record in scene.records)
    if over:
        now_s = max(_end_s(record) for record in scene.records)
    axis = _Axis(max(width - names - status - 3, LEAST_LANE), max(scene.span_s, now_s, 1e-3))
    safe_s = _safe_s(first)
    clock = "" if over else f"  {now_s:.1f} s"
    lines = [Text(f"{scene.title}{clock}", style="bold", no_wrap=True, overflow="ellipsis")]
    lines.append(_row("tokens", names, _tokens(first, axis, None if over else now_s), f"{len(first.token_ns)}"))
    for place, record in enumerate(scene.records):
        lane = _lane(record, axis, now_s, safe_s, COLOURS[place % len(COLOURS)])
        lines.append(_row(record.policy, names, lane, _status(record, scene.n_skills, short=width < NARROW)))
    lines.append(_row("", names, _scale(axis, safe_s, first.ended_ns is not None), "s"))
    return Group(*lines)


def summary(record: Record) -> str:
    stalls = _stalls_s(record)
    if not record.skills or record.requested_ns is None:
        return f"{record.outcome}, nothing was started" + (f": {record.why}" if record.why else "")
    start_s = (record.skills[0].start_ns - record.requested_ns) / 1e9
    why = "" if record.outcome == "completed" else f"; {record.outcome}: {record.why}"
    return (
        f"started at {start_s:.2f} s, ended at {_end_s(record):.2f} s, {len(stalls)} stalls of {sum(stalls):.2f} s{why}"
    )


@dataclass(frozen=True, slots=True)
class _Axis:
    columns: int
    span_s: float

    def column(self, at_s: float) -> int:
        return min(max(int(at_s / self.span_s * self.columns), 0), self.columns - 1)

    def cells(self, from_s: float, to_s: float) -> range:
        first = self.column(from_s)
        return range(first, max(self.column(to_s), first + 1))


def _row(name: str, names: int, lane: Text, status: str) -> Text:
    return Text.assemble(f"{name:<{names}} ", lane, f" {status}", no_wrap=True, overflow="crop")


def _tokens(record: Record, axis: _Axis, now_s: float | None) -> Text:
    cells = [" "] * axis.columns
    zero_ns = record.requested_ns or 0
    for at_ns in list(record.token_ns):
        cells[axis.column((at_ns - zero_ns) / 1e9)] = TOKEN
    for at_ns, _ in list(record.arrivals):
        cells[axis.column((at_ns - zero_ns) / 1e9)] = COMPLETE
    if now_s is not None:
        cells[axis.column(now_s)] = NOW
    return Text("".join(cells))


def _lane(record: Record, axis: _Axis, now_s: float, safe_s: float | None, colour: str) -> Text:
    cells: list[tuple[str, str]] = [(" ", "")] * axis.columns
    zero_ns = record.requested_ns or 0
    skills = list(record.skills)
    starts = [(skill.start_ns - zero_ns) / 1e9 for skill in skills]
    ends = [now_s if skill.end_ns is None else (skill.end_ns - zero_ns) / 1e9 for skill in skills]
    for column in range(axis.column(starts[0] if starts else now_s)):
        cells[column] = (WAITING, "dim")
    until = [*starts[1:], now_s if record.outcome is None else 0.0]
    for start_s, end_s, next_s, skill in zip(starts, ends, until, skills, strict=False):
        if next_s - end_s > TOLERANCE_S:
            for column in axis.cells(end_s, next_s):
                cells[column] = (STALL, "red")
        for column in axis.cells(start_s, end_s):
            cells[column] = (SKILL, colour)
        cells[axis.column(start_s)] = (str((skill.index + 1) % 10), f"bold white on {colour}")
    if safe_s is not None and cells[axis.column(safe_s)][0] in {WAITING, " "}:
        cells[axis.column(safe_s)] = (SAFE, "bold")
    if record.outcome is None and cells[axis.column(now_s)][0] == " ":
        cells[axis.column(now_s)] = (NOW, "")
    return Text.assemble(*cells)


def _status(record: Record, n_skills: int, *, short: bool) -> str:
    done = f"{len(record.ran)}/{n_skills}"
    if record.outcome not in {None, "completed"}:
        return f"{done} {record.outcome}"
    stalls = _stalls_s(record)
    return f"{done} {sum(stalls):.1f}s" if short else f"{done} {len(stalls)} stalls {sum(stalls):.1f} s"


def _stalls_s(record: Record) -> list[float]:
    return [stall / 1e9 for stall in record.stalls_ns if stall > TOLERANCE_S * 1e9]


def _scale(axis: _Axis, safe_s: float | None, complete: bool) -> Text:
    """Return the time axis with S0, in brackets until the whole plan has arrived."""
    cells = [" "] * axis.columns
    step = next(
        (each for each in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if each / axis.span_s * axis.columns > 7),  # noqa: PLR2004 - columns that a number needs
        axis.span_s,
    )
    marks = [(step * place, f"{step * place:g}") for place in range(int(axis.span_s / step) + 1)]
    if safe_s is not None:  # first, so that it replaces a number too near
        marks.insert(0, (safe_s, "S0" if complete else "(S0)"))
    for at_s, text in marks:
        column = min(axis.column(at_s), axis.columns - len(text))
        if not "".join(cells[max(column - 1, 0) : column + len(text) + 1]).strip():
            cells[column : column + len(text)] = text
    return Text("".join(cells), style="dim")


def _safe_s(record: Record) -> float | None:
    """Return S0 of the skills so far; None before the first."""
    safe_s, before_s = None, 0.0
    for at_ns, call in list(record.arrivals):
        at_s = (at_ns - (record.requested_ns or 0)) / 1e9
        safe_s = at_s - before_s if safe_s is None else max(safe_s, at_s - before_s)
        before_s += call.skill.durations.nominal_s
    return safe_s


def _end_s(record: Record) -> float:
    """Return the end of the last skill, or of the stream if none ran."""
    ends = [skill.end_ns for skill in record.ran if skill.end_ns is not None]
    at_ns = ends[-1] if ends else record.ended_ns
    return (at_ns - record.requested_ns) / 1e9 if at_ns is not None and record.requested_ns is not None else 0.0
