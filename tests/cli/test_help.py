"""What answers at once, and what wrong use looks like."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from s2a_bench import __version__
from s2a_bench.cli import app

HEAVY = ("llama_cpp", "cv2", "matplotlib", "pandas")


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a group, its commands and theirs, each with the words that call it."""
    yield path, group
    if hasattr(group, "list_commands"):
        context = typer.Context(group)
        for name in group.list_commands(context):
            yield from commands(group.get_command(context, name), (*path, name))


COMMANDS = dict(commands(typer.main.get_command(app)))
EVERY = pytest.mark.parametrize("path", COMMANDS, ids=" ".join)


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "s2a_bench", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        cwd=cwd,
    )


def test_there_are_commands_and_commands_of_theirs() -> None:
    assert {("latency",), ("boundary",), ("model", "fetch")} <= COMMANDS.keys()


@EVERY
def test_help_is_code_zero_and_names_every_flag(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*path, "--help"])
    assert shown.exit_code == 0
    assert shown.stdout.split()[: 2 + len(path)] == ["Usage:", "s2a-bench", *path]
    for parameter in COMMANDS[path].params:
        if parameter.param_type_name == "option" and not parameter.hidden:
            assert parameter.opts[0] in shown.stdout


@EVERY
def test_every_command_and_every_flag_is_explained(path: tuple[str, ...]) -> None:
    command = COMMANDS[path]
    assert command.help
    assert [parameter.name for parameter in command.params if not getattr(parameter, "help", None)] == []


def test_no_help_imports_anything_heavy() -> None:
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom s2a_bench.cli import app\n"
        f"for path in {list(COMMANDS)}:\n    CliRunner().invoke(app, [*path, '--help'])\n"
        f"print([name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.stdout == "[]\n", done.stderr


def test_the_version_is_printed() -> None:
    assert run("--version").stdout.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bogus"], "No such option: --bogus"),
        (["fly"], "No such command 'fly'"),
        (["latency", "--bogus"], "No such option: --bogus"),
        (["latency", "--runs", "many"], "'--runs'"),
        (["latency", "--port", "70000"], "--port: 70000 should be less than"),
        (["latency", "--payload", "gif"], "--payload: 'gif' is none of raw, yuyv, jpeg, jpeg-preencoded, png"),
        (["latency", "--transport", "http,pigeon"], "--transport: 'pigeon'"),
        (["latency", "--http", "fast"], "--http: 'fast'"),
        (["latency", "--size", "big"], "--size: 'big' should look like 640x480"),
        (["latency", "--engine", "gpt"], "--engine: 'gpt'"),
        (["latency", "--against", "rivals"], "--against: 'rivals' should be paper"),
        (["latency", "--prompt", "@/no/such/file"], "--prompt: cannot read /no/such/file"),
        (["latency", "--grammar", "/no/such/file"], "--grammar: cannot read /no/such/file"),
        (["latency", "--source", "webcam"], "--source: 'webcam' is none of synthetic, video"),
        (["latency", "--source", "video"], "--source: 'video' should be video:FILE"),
        (["latency", "--llama-server", "/no/such/program"], "--llama-server: /no/such/program is no program"),
    ],
)
def test_wrong_use_is_one_line_and_code_two(arguments: list[str], message: str, tmp_path: Path) -> None:
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert message in lines[0]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
