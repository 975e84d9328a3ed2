"""How a sweep sees the other commands: their flags, their parser, and a way to run one in this process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from s2a_bench.cli.experiment import config_of
from s2a_bench.errors import UsageError
from s2a_bench.experiments import EXPERIMENTS

if TYPE_CHECKING:
    from s2a_bench.sweep import Command

ENTRY = f"{__name__}:run"
"""Where a worker finds `run`."""


def command_of(name: str, key: str = "command") -> Command:
    """Describe a command; raises UsageError for one that cannot be swept."""
    from s2a_bench.sweep import Command

    known = sorted(each for each in EXPERIMENTS if " " not in each)
    if name not in known:
        raise UsageError(f"{key}: '{name}' is none of {', '.join(known)}")
    flags: dict[str, Any] = {}
    for parameter in _command(name).params:
        if parameter.param_type_name == "argument":
            flags[parameter.name] = "argument"
            continue
        long = next(flag for flag in parameter.opts if flag.startswith("--"))
        kind = "value" if not parameter.is_flag else "toggle" if parameter.secondary_opts else "switch"
        flags[long.removeprefix("--")] = kind
    return Command(name, flags, lambda argv: _check(name, argv))


def run(argv: Sequence[str]) -> None:
    """Run a command as ``s2a-bench ARGV`` does; raises S2AError."""
    from s2a_bench.cli import ParseError

    try:
        _command(argv[0]).main(args=list(argv[1:]), prog_name=f"s2a-bench {argv[0]}", standalone_mode=False)
    except ParseError as error:
        raise UsageError(error.format_message()) from error


def _check(name: str, argv: Sequence[str]) -> bool:
    """Parse arguments and run nothing; return True if the command would compute and measure nothing."""
    from s2a_bench.cli import ParseError

    try:
        given = _command(name).make_context(name, list(argv)).params
    except ParseError as error:
        raise UsageError(error.format_message()) from error
    return config_of(EXPERIMENTS[name], given).virtual


@cache
def _command(name: str) -> Any:
    """Return a command as the parser has it."""
    from typer.main import get_command

    from s2a_bench.cli import app

    group: Any = get_command(app)
    return group.get_command(None, name)
