"""Run a study: `python -m studies NAME`, with a flag an option."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

from s2a_bench.errors import S2AError, UsageError
from s2a_bench.options import Options, extra_of, group_of, placed
from s2a_bench.store.run import read_run
from s2a_bench.writers.style import paper_column
from studies.config import StudyConfig
from studies.delays import DelaysConfig, run_delays, show_delays
from studies.output import Lines
from studies.run import STUDIES, run_study, show_study
from studies.task.study import TaskStudyConfig, build_task, run_task, show_task
from studies.validity import ValidityConfig, run_validity, show_validity

FIGURES: dict[str, dict[str, Any]] = {
    "targets": {"seed": 20261121},
    "frontier": {},
    "shift": {"seeds": 10, "jobs": 2},
    "split": {"seeds": 10, "jobs": 2},
}
"""The figures of README.md and docs/shift.md, and what they are drawn from."""
DPI = 150


def add_options(parser: argparse.ArgumentParser, options: type[Options], only: tuple[str, ...] = ()) -> None:
    """Add a flag for each option of a configuration, of a group's those that it names."""
    for name, field in options.model_fields.items():
        extra = extra_of(field)
        if inner := group_of(field):
            add_options(parser, inner, tuple(extra["only"]))
        elif not extra["argument"] and (not only or name in only):
            about = str(field.description).replace("%", "%%")
            default = "" if "[default" in about or field.default in (None, "") else f" [default: {field.default}]"
            flag = f"--{(extra['flag'] or name).replace('_', '-')}"
            parser.add_argument(flag, dest=name, default=argparse.SUPPRESS, metavar="X", help=about + default)


def parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    whole = argparse.ArgumentParser("python -m studies", description="Research with the library: studies/README.md.")
    commands = whole.add_subparsers(dest="name", required=True, metavar="NAME")
    for name, study in STUDIES.items():
        _command(commands, name, study.about, StudyConfig)
    _command(commands, "delays", "triggers where delays are not exchangeable", DelaysConfig)
    _command(commands, "task", "what delay costs a task: experts of Meta-World in chunks", TaskStudyConfig)
    _command(commands, "validity", "valid skills in a model's plans, with a grammar and without", ValidityConfig)
    drawn = commands.add_parser("figures", help="draw the figures of README.md and docs/shift.md anew; minutes")
    drawn.add_argument("figures", nargs="*", metavar="FIGURE", help=f"[default: {' '.join(FIGURES)}], or task")
    drawn.add_argument("--output", type=Path, default=Path("results"), help="folder for run folders")
    return whole


def _command(commands: Any, name: str, about: str, options: type[Options]) -> None:
    command = commands.add_parser(name, help=about, description=about)
    add_options(command, options)
    command.add_argument("--output", type=Path, default=Path("results"), help="folder for run folders")


def draw(names: list[str], output: Path) -> None:
    """Run the studies that figures show, and draw these into docs/figures."""
    for name in names or FIGURES:
        if name == "task":
            folder = run_task(TaskStudyConfig(), output, Lines())
        else:
            folder = run_study(StudyConfig(name=name, **FIGURES[name]), output, Lines())
        build = build_task if name == "task" else STUDIES[name].figure
        path = Path(__file__).parent.parent / "docs" / "figures" / f"study-{name}.png"
        with paper_column():
            build(read_run(folder)).savefig(path, dpi=DPI)
        print(path)


def main(arguments: list[str]) -> int:
    """Do what the arguments say and return the exit status: 0 done, 1 failed; wrong use exits with 2."""
    read = parser()
    given = vars(read.parse_args(arguments))
    name, output = given.pop("name"), given.pop("output")
    try:
        if name == "figures":
            draw(given["figures"], output)
        elif name == "delays":
            delays = DelaysConfig(**placed(DelaysConfig, given))
            show_delays(read_run(run_delays(delays, output, Lines())))
        elif name == "task":
            task = TaskStudyConfig(**placed(TaskStudyConfig, given))
            show_task(read_run(run_task(task, output, Lines())))
        elif name == "validity":
            validity = ValidityConfig(**placed(ValidityConfig, given))
            show_validity(read_run(run_validity(validity, output, Lines())))
        else:
            config = StudyConfig(name=name, **placed(StudyConfig, given))
            show_study(read_run(run_study(config, output, Lines())))
    except UsageError as error:
        read.error(_with_flags(error))
    except S2AError as error:
        print(f"error: {_with_flags(error)}", file=sys.stderr)
        return 1
    return 0


def _with_flags(error: S2AError) -> str:
    """Return an error that names flags where the library's names fields."""
    return re.sub(r"`(\w+)`", lambda found: f"--{found[1].replace('_', '-')}", str(error))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
