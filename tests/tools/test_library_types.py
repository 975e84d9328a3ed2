"""The types of the library's keywords are what the options declare, and a type checker goes by them."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.options import places

ROOT = Path(__file__).parent.parent.parent
spec = importlib.util.spec_from_file_location("s2a_library_types", ROOT / "tools/library_types.py")
assert spec is not None
assert spec.loader is not None
tool = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)

PROGRAM = """
import s2a_bench as s2a

run: s2a.Run = s2a.latency(transports=["http", "ros"], size="64x48", resize=(224, 224), latency=20, output="results")
s2a.timeline(rate="2,4", profile=("rtx-4080",), calibrate=run.path, tune=False)
s2a.latency(transportz="http")
s2a.latency(warmup="many")
s2a.chunks(rounding="up")
s2a.timeline(mode="live", task="clear the table", cameras=2, payload="raw")
s2a.timeline(mode="real-time", rate=2)
s2a.ccrb(mode="live", ttc=True), s2a.ccrb(mode="closed-loop", rate=4.8), s2a.ccrb(mode="live-loop", ego="ros")
s2a.chunks(mode="live", seconds=5), s2a.chunks(cycles=100), s2a.capacity(mode="predicted", predict=str(run.path))
s2a.timeline(task="clear the table")
s2a.chunks(mode="virtual", seconds=5)
s2a.capacity(mode="predict", servers=2)
"""

OVERLOADED = {7: "chunks", 12: "timeline", 13: "chunks", 14: "capacity"}
"""Lines of wrong calls of functions with modes."""


def test_the_committed_types_are_what_the_options_declare() -> None:
    assert tool.stub() == tool.STUB.read_text(encoding="utf-8"), "run tools/library_types.py"


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_keyword_is_taken(name: str) -> None:
    for mode in EXPERIMENTS[name].every_mode:
        assert dict(tool.keywords(mode.options)).keys() <= places(mode.options).keys()


@pytest.mark.slow
def test_mypy_refuses_unknown_keywords_other_types_and_options_of_another_mode(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM.lstrip())
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--follow-imports=silent", "program.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert re.findall(r'py:(\d+): error: .*?"(\w+)".*\[([a-z-]+)\]', done.stdout) == [
        ("5", "transportz", "call-arg"),
        ("6", "warmup", "arg-type"),
        *((str(line), name, "call-overload") for line, name in OVERLOADED.items()),
    ]
    assert "Found 6 errors" in done.stdout
