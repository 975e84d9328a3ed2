"""The command line as a user runs it: in a process of its own, or in this one, which begins at once."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from s2a_bench.cli import main
from s2a_bench.machine import tuning
from s2a_bench.store.run import StoredRun, read_run
from tests.made_runs import SCHEMA


def command(*arguments: str | Path) -> list[str]:
    """Return the command line that starts s2a-bench in a process of its own."""
    return [sys.executable, "-m", "s2a_bench", *map(str, arguments)]


def program(*arguments: str | Path, code: int = 0, **settings: Any) -> subprocess.CompletedProcess[str]:
    """Run s2a-bench in a process of its own; ``settings`` are those of `subprocess.run`."""
    done = subprocess.run(command(*arguments), capture_output=True, text=True, check=False, timeout=300, **settings)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def called(*arguments: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run s2a-bench in this process: where nothing is measured, all that differs is the start of Python."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["s2a-bench", *map(str, arguments)])
        patch.setattr(signal, "signal", lambda *_: None)
        patch.setattr(sys, "unraisablehook", sys.unraisablehook)  # it is this process's own again afterwards
        patch.setattr(tuning, "allowed", nullcontext)
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == code, err.getvalue()
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def refused(*arguments: str | Path, code: int = 2) -> str:
    """Return the one line that wrong use comes to."""
    done = called(*arguments, code=code)
    assert done.stdout == ""
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    return line


def only_run(output: Path) -> StoredRun:
    """Return the run that a command left in an output folder of its own."""
    (folder,) = output.iterdir()
    return read_run(folder)


def printed(done: subprocess.CompletedProcess[str], schema: Any = SCHEMA) -> Any:
    """Return the JSON object that a command printed, which keeps its schema."""
    whole = json.loads(done.stdout)
    jsonschema.validate(whole, schema)
    return whole
