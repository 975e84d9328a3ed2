"""What answers at once, and what wrong use looks like."""

from __future__ import annotations

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
    assert called("--version").stdout.strip() == __version__


@pytest.mark.parametrize("group", ["", "model", "profile"])
def test_no_command_at_all_is_a_wish_for_help(group: str) -> None:
    assert called(*group.split()).stdout == called(*group.split(), "--help").stdout
