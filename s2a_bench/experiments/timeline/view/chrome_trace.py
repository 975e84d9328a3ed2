"""Timelines as a trace for ui.perfetto.dev or chrome://tracing: JSON in the Trace Event Format.

A process is one setting (board, granularity, plan length, duration), a thread one policy, and another thread holds
shared tokens. The viewers require ids from 1, distinct thread ids, metadata without a time, and slices that do not
overlap in a thread: boundaries are rounded to a microsecond, the format's unit, before durations are computed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from s2a_bench.errors import StoreError
from s2a_bench.experiments.timeline.view.cells import Timelines, origin_notes, panels, timelines_of

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun

TRACE: Final = "trace.json"
Event: TypeAlias = dict[str, Any]


def to_trace(run: StoredRun) -> dict[str, Any]:
    """Return the trace of every cell's shown plan."""
    cells = [cell for cell in timelines_of(run) if len(cell.skills)]
    return {
        "traceEvents": list(_events(cells)),
        "displayTimeUnit": "ms",
        "otherData": {"command": f"s2a-bench {run.manifest['command']}", "about": " ".join(origin_notes(run, cells))},
    }


def write_trace(run: StoredRun, path: Path) -> None:
    """Write the trace; raises StoreError."""
    try:
        path.write_text(json.dumps(to_trace(run), ensure_ascii=False, allow_nan=False), encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror}; the timelines are kept") from error


def _events(cells: Sequence[Timelines]) -> Iterator[Event]:
    threads = count(1)
    for pid, ((title, tokens, n_skills, t_nom_s), group) in enumerate(panels(cells), start=1):
        name = f"{title}, L = {tokens}, N = {n_skills}, T_nom = {t_nom_s:g} s"
        yield {"ph": "M", "pid": pid, "name": "process_name", "args": {"name": name}}
        yield {"ph": "M", "pid": pid, "name": "process_sort_index", "args": {"sort_index": pid}}
        shared = len({cell.about("request_id") for cell in group}) == 1
        if shared:
            tid = next(threads)
            yield from _thread(pid, tid, "tokens")
            yield from _tokens(pid, tid, group[0])
        for cell in group:
            tid = next(threads)
            yield from _thread(pid, tid, cell.policy)
            yield from _skills(pid, tid, cell)
            if not shared:
                yield from _tokens(pid, tid, cell)


def _thread(pid: int, tid: int, name: str) -> Iterator[Event]:
    yield {"ph": "M", "pid": pid, "tid": tid, "name": "thread_name", "args": {"name": name}}
    yield {"ph": "M", "pid": pid, "tid": tid, "name": "thread_sort_index", "args": {"sort_index": tid}}


def _tokens(pid: int, tid: int, cell: Timelines) -> Iterator[Event]:
    for index, at_s in enumerate(cell.token_s):
        yield _instant(pid, tid, f"token {index + 1}", round(at_s * 1e6))
    for skill in cell.skills.to_dict("records"):
        yield _instant(pid, tid, f"skill {skill['index'] + 1} complete", _us(skill["arrival_ns"]))


def _skills(pid: int, tid: int, cell: Timelines) -> Iterator[Event]:
    yield _instant(pid, tid, "S0", round(cell.moment_s("safe_start_s") * 1e6))
    yield from _slice(pid, tid, "waiting", 0, round(cell.moment_s("start_s") * 1e6), {})
    for skill in cell.skills.to_dict("records"):
        start_ns, end_ns = skill["start_ns"], skill["end_ns"]
        if skill["stall_ns"]:
            before = {"before skill": skill["index"] + 1, "ms": skill["stall_ns"] / 1e6}
            yield from _slice(pid, tid, "stall", _us(start_ns - skill["stall_ns"]), _us(start_ns), before)
        facts = {
            "queue wait (ms)": skill["queue_wait_ns"] / 1e6,
            "nominal (ms)": skill["nominal_ns"] / 1e6,
            "stretch": skill["stretch"],
        }
        text = skill["text"] or f"skill {skill['index'] + 1}"
        yield from _slice(pid, tid, text, _us(start_ns), _us(end_ns), facts)


def _slice(pid: int, tid: int, name: str, start_us: int, end_us: int, args: dict[str, Any]) -> Iterator[Event]:
    """Yield a complete event, unless it is shorter than the unit."""
    if end_us > start_us:
        event = {"ph": "X", "pid": pid, "tid": tid, "name": name, "cat": "timeline"}
        yield {**event, "ts": start_us, "dur": end_us - start_us, "args": args}


def _instant(pid: int, tid: int, name: str, at_us: int) -> Event:
    return {"ph": "i", "s": "t", "pid": pid, "tid": tid, "name": name, "cat": "timeline", "ts": at_us}


def _us(value_ns: int) -> int:
    return round(value_ns / 1e3)
