"""What happens where a limit of the process is reached: one line."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
from pathlib import Path
from unittest.mock import Mock

import pytest

from s2a_bench import cli
from s2a_bench.cli import shortage
from tests.cli.program import command, refused

LATENCY = ["latency", "--engine", "echo", "--transport", "loopback", "--size", "64x48", "--data-only"]


def run(kind: int, limit: int, output: Path, *more: str) -> list[str]:
    """Run latency below a limit; return its lines on stderr, the last of which is the error."""
    done = subprocess.run(
        command(*LATENCY, *more, "--output", output),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(kind, (limit, limit)),
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    *lines, last = done.stderr.splitlines()
    assert last.startswith("error: ")
    return [*lines, last]


@pytest.mark.parametrize("files", [10, 63])
def test_too_few_open_files_are_told_before_anything_begins(tmp_path: Path, files: int) -> None:
    lines = run(resource.RLIMIT_NOFILE, files, tmp_path)
    assert lines == [f"error: this process may open {files} files, and 64 are needed; raise `ulimit -n`"]
    assert not list(tmp_path.iterdir())


def test_too_little_address_space_is_told_before_anything_begins(tmp_path: Path) -> None:
    (line,) = run(resource.RLIMIT_AS, 400 * 2**20, tmp_path)
    assert "may use 400 MiB of address space, and 1024 are needed; raise `ulimit -v`" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "too many open files; raise `ulimit -n`"),
        (OSError(errno.ENOSPC, "No space left on device", "/a/b"), "/a/b'; free some space"),
        (MemoryError(), "out of memory; "),
        (ImportError("x.so: failed to map segment from shared object"), "out of memory; "),
        (RuntimeError("can't start new thread"), "no more processes or threads"),
    ],
)
def test_what_there_is_too_little_of_is_named(error: Exception, line: str) -> None:
    assert line in str(shortage(error))


@pytest.mark.parametrize("error", [RuntimeError("x"), ImportError("no module"), OSError(errno.ENOENT, "x")])
def test_other_errors_are_not_taken_for_a_shortage(error: Exception) -> None:
    assert shortage(error) is None


def test_a_broken_pipe_is_quiet_only_where_the_reader_of_the_output_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as unread:
        done = subprocess.run(command("profile", "list"), stdout=unread, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")

    broken = Mock(info=cli.app.info, side_effect=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    monkeypatch.setattr(cli, "app", broken)
    assert "error: another program ended while it was written to: [Errno 32]" in refused("doctor", code=1)
