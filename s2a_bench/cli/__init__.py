"""The command line: one module per command, and one place where errors become a line and an exit code.

The modules of this package import heavy libraries inside functions, so that ``--help`` is fast.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from errno import EAGAIN, EDQUOT, EMFILE, ENFILE, ENOMEM, ENOSPC
from typing import Any, ClassVar, Final

import typer

from s2a_bench import __version__
from s2a_bench.cli.adapter import with_flags
from s2a_bench.cli.experiment import PLAIN, Commands, ParseError
from s2a_bench.cli.output import print_error
from s2a_bench.cli.ros_args import folded
from s2a_bench.errors import NotPermitted, S2AError
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.machine import tuning
from s2a_bench.registry import Registry, missing_entry_points

INTERRUPTED: Final = 130
AGAIN_S: Final = 0.01
COMMANDS: Final[Registry[tuple[str, str]]] = Registry("commands", "command", {})
"""Commands of installed packages, declared as in `Commands.lazy`: declarations import nothing."""


_OURS: Final = {
    "compare": ("report:compare", "Compare run B with run A: effect sizes with intervals, one test, gates for CI."),
    "demo": ("demo:demo", "A first look in 20 seconds, without a model: both questions on one page."),
    "doctor": ("doctor:doctor", "Check this machine: a line for each finding, warnings with their fix."),
    "model": ("model:app", "Fetch, make and inspect model files."),
    "profile": ("profile:app", "Measure this machine as a hardware profile, and show profiles."),
    "report": ("report:report", "Make one page of runs, and their tables and figures for a paper. Measures nothing."),
    "serve": ("serve:serve", "Serve a model until interrupted: over HTTP, ROS 2 or another transport."),
    "sweep": ("sweep:sweep", "Run a command for every cell of a grid; an interrupted sweep can be resumed."),
}


class TopCommands(Commands):
    """All commands: those listed below, the experiments, and those of other packages with a name of their own."""

    experiments = EXPERIMENTS
    lazy: ClassVar[Mapping[str, tuple[str, str]]] = {
        name: offered for name, offered in COMMANDS.loaded() if name not in EXPERIMENTS
    } | {name: (f"s2a_bench.cli.{where}", about) for name, (where, about) in _OURS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command; raises UsageError for that of a package that does not load."""
        if args[0] in COMMANDS and args[0] not in self.list_commands(ctx):
            _ = COMMANDS[args[0]]
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=TopCommands,
    name="s2a-bench",
    help="Measure how a vision-language model is wired to a robot, and when the robot may act.",
    **PLAIN | {"add_completion": True},
)


@app.callback(invoke_without_command=True)
def _version(*, version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _interrupt_again(dropped: sys.UnraisableHookArgs) -> None:
    """Raise a KeyboardInterrupt again in a moment if Python dropped it, in a destructor, a callback or after a fork."""
    if issubclass(dropped.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    else:
        sys.__unraisablehook__(dropped)


def _interrupt_on_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup leaves it
            signal.signal(number, _interrupt)
    sys.unraisablehook = _interrupt_again


def main() -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 wrongly used, 130 interrupted."""
    _interrupt_on_signals()
    try:
        check_limits()
        _note_missing_plug_ins()
        with tuning.allowed():
            code = app(args=folded(sys.argv[1:]), prog_name=app.info.name, standalone_mode=False)
        if code == INTERRUPTED:  # newer typer turns Ctrl-C into this code itself
            print_error("interrupted")
    except S2AError as error:
        if isinstance(error, NotPermitted):
            _enter_user_namespace()
        print_error(f"error: {with_flags(str(error))}")
        code = error.exit_code
    except ParseError as error:
        context = getattr(error, "ctx", None)
        hint = f" (see '{context.command_path} --help')" if context else ""
        if close := getattr(error, "possibilities", None):  # of an unknown option, the closest first
            hidden = {name for each in context.command.params if each.hidden for name in each.opts} if context else ()
            error.possibilities = close = [name for name in close if name not in hidden]
        message = f"{error.message}; did you mean {close[0]}?" if close else error.format_message()
        print_error(f"error: {message}{hint}")
        code = error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        print_error("interrupted")
        code = INTERRUPTED
    except BrokenPipeError as error:
        _print_broken(error)
        code = 1
    except (OSError, MemoryError, RuntimeError, ImportError) as error:
        if (line := shortage(error)) is None:
            raise
        print_error(f"error: {line}")
        code = 1
    sys.exit(code if isinstance(code, int) else 0)


def _note_missing_plug_ins() -> None:
    if missing := missing_entry_points():
        print_error(f"note: this checkout was installed before it had {', '.join(missing)}: run `make setup`")


def _print_broken(error: BrokenPipeError) -> None:
    """Print the error, but end quietly if the reader of standard output or error has ended, as `| head` does."""
    outputs = select.poll()
    for number in (1, 2):
        outputs.register(number, 0)  # errors only
    if outputs.poll(0):
        sys.stderr.close()
    else:
        print_error(f"error: another program ended while it was written to: {error}")


def _enter_user_namespace() -> None:
    """Execute the command again in a user namespace of its own, where it may create others; return if that fails."""
    enter = ("unshare", "--user", "--map-root-user", "--net")
    with suppress(OSError):
        if not subprocess.run([*enter, "true"], check=False, capture_output=True).returncode:  # noqa: S603
            os.execvp(enter[0], [*enter, sys.executable, "-m", "s2a_bench", *sys.argv[1:]])  # noqa: S606


LEAST_FILES: Final = 64
LEAST_BYTES: Final = 2**30
"""Address space; with less, loading the numerical libraries ends the process."""


def check_limits() -> None:
    """Raise S2AError if this process may use too few files or too little address space for any command."""
    files, space = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_AS))
    if files != resource.RLIM_INFINITY and files < LEAST_FILES:
        raise S2AError(f"this process may open {files} files, and {LEAST_FILES} are needed; raise `ulimit -n`")
    if space != resource.RLIM_INFINITY and space < LEAST_BYTES:
        raise S2AError(
            f"this process may use {space >> 20} MiB of address space, and {LEAST_BYTES >> 20} are needed; "
            "raise `ulimit -v`"
        )


def shortage(error: Exception) -> str | None:
    """Return a line that names the exhausted resource and the way out; None for any other error."""
    number = getattr(error, "errno", None)
    text = str(error)
    if number in {EMFILE, ENFILE}:
        return "too many open files; raise `ulimit -n`, or stop other programs that have files open"
    if number in {ENOSPC, EDQUOT}:
        return f"{text}; free some space, or choose another folder"
    if isinstance(error, MemoryError) or number == ENOMEM or "failed to map segment" in text:
        return "out of memory; stop other programs, raise `ulimit -v`, or ask for less"
    if number == EAGAIN or "can't start new thread" in text:
        return "no more processes or threads may be started; raise `ulimit -u` or `ulimit -v`"
    return None
