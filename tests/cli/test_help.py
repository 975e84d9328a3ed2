"""What answers at once, and what wrong use looks like."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from s2a_bench import __version__
from s2a_bench.cli import app
from tests.cli.program import called

LIVE = "with --live"
HEAVY = ("cv2", "llama_cpp", "matplotlib", "pandas", "ray", "scipy")


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a group, its commands and theirs, each with the words that call it."""
    yield path, group
    if hasattr(group, "list_commands"):
        context = typer.Context(group)
        for name in group.list_commands(context):
            yield from commands(group.get_command(context, name), (*path, name))


COMMANDS = dict(commands(typer.main.get_command(app)))
EVERY = pytest.mark.parametrize("path", COMMANDS, ids=" ".join)


@EVERY
def test_help_is_code_zero_and_names_every_flag(path: tuple[str, ...]) -> None:
    flags = [each.opts[0] for each in COMMANDS[path].params if not getattr(each, "hidden", False)]
    shown = CliRunner().invoke(app, [*path, "--help-all" if "--help-all" in flags else "--help"])
    assert shown.exit_code == 0
    assert shown.stdout.split()[: 2 + len(path)] == ["Usage:", "s2a-bench", *path]
    assert [flag for flag in flags if flag.startswith("-") and flag not in shown.stdout] == []
    assert max(map(len, shown.stdout.splitlines())) <= 80


@pytest.mark.parametrize(
    ("command", "headings"),
    [
        ("latency", ["Transport", "Pictures", "Model", "Requests", "Options"]),
        (
            "timeline",
            ["Modes", "Policies", "Plans", f"Tokens that are modelled (not {LIVE})", f"Transport ({LIVE})", "Options"],
        ),
        ("ccrb", ["Modes", "Policies", "Drives", "Scenario", f"Drives (not {LIVE} or --closed-loop)", "Options"]),
        ("serve", ["Arguments", "Model", "Transport", "ROS 2", "Options"]),
    ],
)
def test_help_shows_first_what_matters_first(command: str, headings: list[str]) -> None:
    lines = called(command, "--help").stdout.splitlines()
    assert [line.removesuffix(":") for line in lines if re.fullmatch(r"[A-Z].*:", line)] == headings
    assert 8 <= sum(line.startswith("  --") for line in lines) <= 14
    assert re.fullmatch(r"  --help-all +Show all \d\d options and exit.", lines[-1])


@EVERY
def test_every_command_and_every_flag_is_explained(path: tuple[str, ...]) -> None:
    command = COMMANDS[path]
    assert command.help
    assert [each.name for each in command.params if not (each.hidden or each.help)] == []


def test_no_help_imports_anything_heavy() -> None:
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom s2a_bench.cli import app\n"
        f"for path in {list(COMMANDS)}:\n    CliRunner().invoke(app, [*path, '--help'])\n"
        f"print([name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.stdout == "[]\n", done.stderr


def test_the_version_is_printed() -> None:
    assert called("--version").stdout.strip() == __version__


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("thr", "throughput"),
        ("model ", "dummy fetch list"),
        ("latency --fl", "--flash-attention"),
        ("latency --transport http,ros", "http,ros http,ros/topic http,ros/action"),
        ("serve http/b", "http/best-effort http/binary"),
        ("latency --engine ", "llama echo replay call"),
        ("latency --mode ", "request stream"),
        ("latency --dialect o", "openai ollama openvla"),
        ("ccrb --profile j", "jetson-agx-orin jetson-orin-nano"),
        ("timeline --policy naive,s2a", "naive,s2a-clairvoyant naive,s2a-mean"),
        ("chunks --modes q", "queue"),
        ("sweep ", "links paper quick task transports"),
        ("profile show r", "rtx-4080"),
    ],
)
def test_a_shell_completes_names(line: str, offered: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = f"s2a-bench {line}"
    monkeypatch.setenv("_S2A_BENCH_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(words.count(" ")))
    assert called().stdout.split() == offered.split()


@pytest.mark.parametrize("group", ["", "model", "profile"])
def test_no_command_at_all_is_a_wish_for_help(group: str) -> None:
    assert called(*group.split()).stdout == called(*group.split(), "--help").stdout
