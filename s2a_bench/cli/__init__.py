"""The command line: one module per command, and one place where errors become a line and an exit code.

Modules here import heavy libraries inside their functions only, so that ``--help`` answers at once.
"""

from __future__ import annotations

import signal
import sys
from typing import Any, ClassVar

import typer

from s2a_bench import __version__
from s2a_bench.cli.adapter import with_flags
from s2a_bench.cli.experiment import Commands
from s2a_bench.cli.output import shown
from s2a_bench.cli.ros_args import folded
from s2a_bench.cli.shortage import check_limits, shortage
from s2a_bench.errors import S2AError
from s2a_bench.machine import tuning

INTERRUPTED = 130
ParseError: Any = typer.BadParameter.__mro__[1]
"""Click's UsageError: newer typer brings a click of its own, so it cannot be named by import."""


class TopCommands(Commands):
    """The commands below, and the experiments."""

    lazy: ClassVar[dict[str, tuple[str, str]]] = {
        name: (f"s2a_bench.cli.{name}:{what}", about)
        for name, what, about in (
            ("compare", "compare", "Compare run B with run A: effect sizes with intervals, one test, gates for CI."),
            ("doctor", "doctor", "Check this machine: a line for each finding, warnings with what mends them."),
            ("model", "app", "Fetch, make and inspect model files."),
            ("profile", "app", "Measure this machine as a hardware profile, and look at profiles."),
            ("report", "report", "Make one page of runs, and their tables and figures for a paper. Measures nothing."),
            ("serve", "serve", "Serve a model until interrupted: over HTTP, as a ROS 2 node, or otherwise."),
            ("sweep", "sweep", "Run a command for every cell of a grid; what is done is kept, and it can go on."),
        )
    }


app = typer.Typer(
    cls=TopCommands,
    name="s2a-bench",
    help="Measure how a vision-language model is wired to a robot, and when the robot may act.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)


@app.callback(invoke_without_command=True)
def _version(*, version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 wrongly used, 130 interrupted."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        check_limits()
        with tuning.allowed():
            code = app(args=folded(sys.argv[1:]), standalone_mode=False)
        if code == INTERRUPTED:  # newer typer turns Ctrl-C into this code itself
            _say("interrupted", INTERRUPTED)
    except S2AError as error:
        code = _say(f"error: {with_flags(str(error))}", error.exit_code)
    except ParseError as error:
        context = getattr(error, "ctx", None)
        hint = f" (see '{context.command_path} --help')" if context else ""
        code = _say(f"error: {error.format_message()}{hint}", error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = _say("interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        sys.stderr.close()
        code = 1
    except (OSError, MemoryError, RuntimeError, ImportError) as error:
        line = shortage(error)
        if line is None:
            raise
        code = _say(f"error: {line}", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _say(line: str, code: int) -> int:
    print(shown(line), file=sys.stderr)  # noqa: T201 - the command line's own output
    return code
