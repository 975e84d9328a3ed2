"""Timelines while they happen: what stands on the terminal at a moment, at any width."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from s2a_bench.act.events import AbortRequested, StreamBroke
from s2a_bench.act.record import Record
from s2a_bench.cli.progress import RunProgress
from s2a_bench.experiments.timeline.watch import STALL, Scene, draw, summary
from s2a_bench.progress import watching
from tests.act.drive import ns, plan, run

THREE = ("naive", "wait-then-act", "stream-to-act")
ARRIVALS = [2.0, 4.0, 6.0, 8.0]


def scene(records: list[Record], span_s: float = 10.0) -> Scene:
    return Scene("A board, 4.8 tokens/s", records, len(ARRIVALS), span_s)


def finished(*names: str) -> list[Record]:
    return [run(plan(ARRIVALS), len(ARRIVALS), by=name)[0] for name in names]


def text(scene: Scene, at_s: float, width: int) -> list[str]:
    """Return what stands on a terminal of that width."""
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(draw(scene, ns(at_s), width))
    output: str = console.file.getvalue()  # type: ignore[attr-defined]
    return output.splitlines()


def under_way(records: list[Record], at_s: float) -> list[Record]:
    """Return the records as they were at a moment."""
    kept = []
    for record in records:
        early = Record(record.policy, record.requested_ns)
        early.token_ns = [at for at in record.token_ns if at <= ns(at_s)]
        early.arrivals = [(at, call) for at, call in record.arrivals if at <= ns(at_s)]
        early.skills = [skill for skill in record.skills if skill.start_ns <= ns(at_s)]
        for skill in early.skills:
            if skill.end_ns is not None and skill.end_ns > ns(at_s):
                skill.end_ns = None
        kept.append(early)
    return kept


def lane(lines: list[str], name: str) -> str:
    (found,) = [line for line in lines if line.startswith(name)]
    return found.removeprefix(name).strip()


def test_a_finished_scene_shows_every_policy_s_skills_and_stalls() -> None:
    lines = text(scene(finished("naive", "wait-then-act")), 0.0, 80 + 14 + 14)
    assert lines[0] == "A board, 4.8 tokens/s"
    naive, wait = lane(lines, "naive"), lane(lines, "wait-then-act")
    assert [mark for mark in naive.split("  ")[0] if mark in "12345678"] == list("1234")
    assert naive.count(STALL) in range(18, 26)  # 3 of 11 s
    assert naive.endswith("4/4 3 stalls 3.0 s")
    assert STALL not in wait
    assert wait.index("1") > naive.index("3")
    assert wait.endswith("4/4 0 stalls 0.0 s")
    assert "S0" in lines[-1]
    assert "(S0)" not in lines[-1]


def test_while_it_runs_the_present_is_marked_and_s0_is_so_far() -> None:
    lines = text(scene(under_way(finished(*THREE), 4.5)), 4.5, 100)
    assert lines[0].endswith("4.5 s")
    assert lane(lines, "tokens").count("┃") == 2
    assert lane(lines, "naive").endswith("1/4 1 stalls 1.0 s")
    assert lane(lines, "wait-then-act").endswith("0/4 0 stalls 0.0 s")
    assert "│" in lane(lines, "wait-then-act")
    assert "(S0)" in lines[-1]


@given(width=st.integers(30, 250), at_s=st.floats(0, 30), span_s=st.floats(0.001, 1000))
def test_no_line_is_wider_than_the_terminal(width: int, at_s: float, span_s: float) -> None:
    for records in (finished("naive"), under_way(finished("naive"), at_s), [Record("naive")]):
        lines = text(scene(records, span_s), at_s, width)
        assert len(lines) == 4
        assert all(len(line) <= width for line in lines)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (StreamBroke(ns(4.5), "stream-error", "cable"), "2/4 stream-error"),
        (AbortRequested(ns(4.5)), "2/4 aborted"),
    ],
)
def test_what_went_wrong_stands_where_the_numbers_would(event: StreamBroke | AbortRequested, words: str) -> None:
    events = [each for each in plan(ARRIVALS) if each.at_ns <= ns(4.5)]
    record, _ = run([*events, event], len(ARRIVALS))
    line = lane(text(scene([record]), 9.0, 100), "naive")
    assert line.endswith(words)
    assert summary(record).startswith("started at 2.00 s, ended at ")
    assert event.why in summary(record)


def test_without_a_terminal_every_policy_gets_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    view = RunProgress()
    with view, watching(view, scene(finished(*THREE))):
        pass
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "  naive: started at 2.00 s, ended at 9.00 s, 3 stalls of 3.00 s"
    assert lines[1] == "  wait-then-act: started at 8.00 s, ended at 12.00 s, 0 stalls of 0.00 s"
    assert len(lines) == 3


def test_a_plan_of_which_nothing_came_is_said_in_words() -> None:
    record, _ = run([plan([])[0], StreamBroke(ns(1), "silence", "no token for 9 s")], 2)
    assert summary(record) == "silence, nothing was started: no token for 9 s"
