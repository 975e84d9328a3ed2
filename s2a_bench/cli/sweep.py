"""`s2a-bench sweep`: run a command for a grid of settings from a file."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from s2a_bench import extras
from s2a_bench.cli.adapter import build, command, flags_named
from s2a_bench.cli.experiment import ParseError, click_command, options_of
from s2a_bench.cli.output import Json, print_error, print_json, print_line, print_table
from s2a_bench.cli.output import console as open_console
from s2a_bench.errors import MissingExtra, S2AError, UsageError
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.machine.environment import collect
from s2a_bench.secrets import struck
from s2a_bench.store.run import RunWriter
from s2a_bench.store.sweep import CELLS, Sweep, read_sweep
from s2a_bench.sweep import CellWorkers, SweepCell, SweepCommand, SweepConfig
from s2a_bench.sweep.file import read_sweep_file
from s2a_bench.sweep.json import plan_json, sweep_json
from s2a_bench.sweep.perform import LocalWorkers, RayWorkers
from s2a_bench.sweep.plan import SweepPlan, plan_sweep
from s2a_bench.sweep.run import SweepRun, check_resume, only_one, pending, start_sweep
from s2a_bench.text import none_of, visible
from s2a_bench.transport.listening import is_loopback
from s2a_bench.writers.tables import TextTable


def _sweep(config: SweepConfig, *, json_: Json = False) -> None:
    from s2a_bench.cli.progress import RunProgress

    resume, source, boards = config.resume, config.source, config.boards
    trust = " --trust-file" if config.trust_file else ""
    file = read_sweep_file(source)
    with extras.noted() as missing:
        plan = plan_sweep(file, command_of(file.command, f"{source}: command", trusted=config.trust_file), boards)
    if resume is not None:
        check_resume(resume, plan)
    if config.dry_run:
        _show_plan(plan, config, missing, as_json=json_)
        return
    if missing:
        raise MissingExtra(_lacking(source, missing))
    with RunProgress("cells") as progress, ExitStack() as stack:
        if config.ray:
            workers: CellWorkers = RayWorkers(ENTRY, config.ray, plan, config.width)
        else:
            workers = LocalWorkers(ENTRY, config.width)
        if resume is None:
            writer = start_sweep(plan, source, config.output, boards)
            stack.enter_context(only_one(writer.path))
        else:
            stack.enter_context(only_one(resume))
            writer = RunWriter.reopen(resume, [CELLS])
        progress.opened(writer.path)
        try:
            with writer:
                sitting = SweepRun(writer, plan, progress)
                with workers:
                    sitting.work(workers, retry_failed=config.retry_failed)
                sitting.finish()
        except (S2AError, KeyboardInterrupt):
            if writer.path.exists():
                progress.say(f"sweep so far: {writer.path}; go on with: s2a-bench sweep --resume {writer.path}{trust}")
            raise
    swept = read_sweep(writer.path)
    if json_:
        print_json(sweep_json(swept))
    else:
        print_sweep(swept)
    if sitting.failed:
        raise S2AError(
            f"{sitting.failed} of {len(plan.cells)} cells failed; run them again with: "
            f"s2a-bench sweep --resume {writer.path} --retry-failed{trust}"
        )


def _lacking(source: Path, missing: Collection[str]) -> str:
    return f"{source}: its cells need packages that are not installed; {extras.how_to_install(*missing)}"


def _show_plan(plan: SweepPlan, config: SweepConfig, missing: Collection[str], *, as_json: bool) -> None:
    resume = config.resume
    cells = pending(plan, read_sweep(resume).attempts.to_dict("records") if resume else [], retry_failed=False)
    if as_json:
        print_json(plan_json(cells, collect()))
    else:
        print_plan(plan, cells)
    if missing:
        print_error(_lacking(config.source, missing))


sweep = command(_sweep, SweepConfig)


def print_plan(plan: SweepPlan, cells: Sequence[SweepCell]) -> None:
    console = open_console()
    for cell in cells:
        board = f"  on {cell.board}" if cell.board else ""
        line = visible(f"{cell.label}  s2a-bench {shlex.join(cell.argv)}{board}")
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    virtual = sum(cell.virtual for cell in cells)
    counts = f"{len(cells)} of {len(plan.cells)} cells to run, {virtual} virtual and {len(cells) - virtual} measured"
    rests = f", {plan.rest_s:g} s of rest after each measured one" if plan.rest_s and virtual < len(cells) else ""
    print_line(f"{counts}{rests}")


def print_sweep(sweep: Sweep) -> None:
    cells = sweep.cells
    failed = cells[cells["state"] == "failed"]
    if len(failed):
        rows = []
        for row in failed.to_dict("records"):
            setting = " ".join(f"{key}={value}" for key, value in json.loads(row["settings"]).items())
            rows.append(tuple(map(struck, (f"{row['cell']}-r{row['repeat']}", setting, row["error"]))))
        print_table(TextTable("Cells that failed", ("cell", "setting", "error"), rows, 3))
    print_line(f"{len(cells) - len(failed)} of {len(cells)} cells finished on {', '.join(sorted(set(cells['host'])))}")
    print_line(f"sweep folder: {sweep.path}")


ENTRY = f"{__name__}:run"


def command_of(name: str, key: str = "command", *, trusted: bool = False) -> SweepCommand:
    """Describe a command; cells of a ``trusted`` file may run programs, and send keys and files to a URL."""
    names = sorted(EXPERIMENTS)
    if name not in names:
        raise UsageError(f"{key}: {none_of(name, names)}")
    flags: dict[str, Any] = {}
    for parameter in click_command(name).params:
        if parameter.param_type_name == "argument":
            flags[parameter.name] = "argument"
        else:
            long = next(flag for flag in parameter.opts if flag.startswith("--"))
            kind = "hidden" if parameter.hidden else "value"
            if parameter.is_flag:
                kind = "toggle" if parameter.secondary_opts else "switch"
            flags[long.removeprefix("--")] = kind
    return SweepCommand(name, flags, lambda argv: _check(name, argv, trusted=trusted))


def run(argv: Sequence[str]) -> None:
    """Run a command as ``s2a-bench ARGV`` does; raises S2AError."""
    try:
        click_command(argv[0]).main(args=list(argv[1:]), prog_name=f"s2a-bench {argv[0]}", standalone_mode=False)
    except ParseError as error:
        raise UsageError(error.format_message()) from error


def _check(name: str, argv: Sequence[str], *, trusted: bool) -> bool:
    """Parse arguments without running them; return True if the command only computes and measures nothing."""
    try:
        values = click_command(name).make_context(name, list(argv)).params
    except ParseError as error:
        raise UsageError(error.format_message()) from error
    kinds = options_of(EXPERIMENTS[name])
    with flags_named(*kinds):
        config = build(kinds[0], values)
        if not trusted and (risk := _risk([*config.risks()])):
            raise UsageError(f"{risk}; read the file, and allow it with `trust_file`")
    return config.virtual


def _risk(risks: Sequence[tuple[str, str, str]]) -> str:
    """Return the risk that an untrusted file may not take, "" if there is none."""
    named = {risk: name for name, risk, _ in risks}
    if "program" in named:
        return f"`{named['program']}` runs a program"
    if {"url", "key"} <= named.keys():
        return f"`{named['key']}` sends a key to a URL"
    remote = (name for name, risk, value in risks if risk == "url" and not _is_loopback(value))
    return next((f"`{name}` sends requests off this machine" for name in remote), "")


def _is_loopback(url: str) -> bool:
    """Return True if a URL, or an endpoint as tcp/HOST:PORT, is on loopback; no name is resolved."""
    return is_loopback(urlsplit(url if "://" in url else url.replace("/", "://", 1)).hostname or "")
