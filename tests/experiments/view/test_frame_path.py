"""The frame path of a stream."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from s2a_bench.experiments.latency.view import show
from s2a_bench.store.requests import FrameRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.trace import Mark
from tests.made_runs import STAGES, row_of

MS = 1_000_000
PROMPT: list[Mark] = [("", 0), ("cdr_pack", MS), ("network", 2 * MS), ("inference", 4 * MS), ("return", 5 * MS)]
SAMPLE = row_of("ros/topic", {}, 0, mode="stream", request_id="r0", marks=PROMPT, frame_age_ns=12 * MS)
FRAME: list[Mark] = [("", 10 * MS), ("capture", 11 * MS), ("convert", 13 * MS), ("", 14 * MS), ("network", 17 * MS)]


@pytest.fixture
def run(tmp_path: Path) -> StoredRun:
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as writer:
        writer.sample(SAMPLE)
        writer.sample(replace(SAMPLE, request_id="r1", warmup=True))
        writer.frame(FrameRow("ros/topic", 3, 9 * MS, FRAME, "r0"))
        writer.frame(FrameRow("ros/topic", 4, 9 * MS, [("", 0), ("capture", 99 * MS)], "r1"))
        writer.frame(FrameRow("ros/topic", 5, 9 * MS, [("", 0), ("capture", 99 * MS)]))
    return read_run(writer.path)


def test_only_frames_of_counted_samples_count(run: StoredRun) -> None:
    assert show(run).tables["frames"].rows == [
        ("capture", "capture", "1.00"),
        ("encode", "convert", "2.00"),
        ("network", "network", "3.00"),
        ("", "residual", "1.00"),
        ("", "frame path", "7.00"),
        ("", "frame path from the intended time", "8.00"),
        ("", "age when inference starts", "12.0"),
    ]


def test_a_run_without_a_stream_has_no_such_table(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as writer:
        writer.sample(SAMPLE)
    assert "frames" not in show(read_run(writer.path)).tables
