"""Files survive `kill -9`, and a disk or a process without room: what was measured can be read."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

from s2a_bench.store.run import read_run
from tests.cli.program import command, only_run
from tests.hostile.conftest import KilledRun


def test_a_run_that_was_killed_keeps_every_row_that_was_written(killed_run: KilledRun) -> None:
    run = read_run(killed_run.folder)
    assert run.manifest["state"] == "running"
    assert len(run.samples) >= killed_run.rows >= 60
    assert (run.samples.error == "").all()


def test_it_leaves_nothing_in_shared_memory(killed_run: KilledRun) -> None:
    assert "/shm/" not in killed_run.files


def test_a_file_that_may_not_grow_ends_the_run_in_one_line_with_its_samples(tmp_path: Path) -> None:
    options = ("--engine", "echo", "--transport", "loopback", "--size", "64x48", "--data-only", "--requests", "1000000")
    done = subprocess.run(
        command("latency", *options, "--output", tmp_path),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000)),
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("csv: File too large; samples so far are kept")
    kept = only_run(tmp_path)
    assert kept.manifest["state"] == "failed"
    assert len(kept.samples) > 100
