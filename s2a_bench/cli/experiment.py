"""The command of an experiment: its options become flags, it runs, and what its run shows is written and printed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.adapter import build, command, flags_named
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json
from s2a_bench.errors import S2AError

if TYPE_CHECKING:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments import Experiment, Shown
    from s2a_bench.options import Options
    from s2a_bench.store.run import Run


def _own(
    output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
    data_only: Annotated[
        bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Hold the flags that every experiment has."""


def options_of(experiment: Experiment) -> tuple[type[Options], ...]:
    """Return the classes of an experiment's options: what is run, and how it is shown."""
    return tuple(resolve_name(name) for name in (experiment.config, experiment.view_options) if name)


def config_of(experiment: Experiment, given: Mapping[str, Any]) -> Options:
    """Return the configuration that the parameters of its command make; raises UsageError naming the flag."""
    config = options_of(experiment)[0]
    with flags_named(config):
        return build(config, given)


def command_of(experiment: Experiment) -> Callable[..., None]:
    """Return the function that typer makes the experiment's command of."""

    def run(config: Options, *view: Options, output: Path, data_only: bool, json_: bool) -> None:
        asked = view[0].model_dump() if view else {}
        _run(experiment, config, output, asked, data_only=data_only, as_json=json_)

    own = inspect.signature(_own, eval_str=True).parameters
    more = {name: parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for name, parameter in own.items()}
    return command(run, *options_of(experiment), about=experiment.about, more=more)


def _run(
    experiment: Experiment, config: Options, output: Path, asked: dict[str, Any], *, data_only: bool, as_json: bool
) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.files import write_shown
    from s2a_bench.store.run import read_run

    with RunProgress(experiment.unit) as progress:
        try:
            folder = experiment.run_with(config, output, progress)
            run = read_run(folder)
            shown = experiment.show(run, **asked)
            if not data_only:
                progress.stage("drawing")
                write_shown(run, shown)
            present(run, shown, progress, as_json=as_json)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None:
                progress.say(f"{experiment.unit} so far: {progress.folder}")
            raise


def present(run: Run, shown: Shown, progress: RunProgress, *, as_json: bool) -> None:
    """Print warnings, and then the tables or the one JSON object."""
    from s2a_bench.writers.terminal import lay_out

    for warning in run.manifest["warnings"]:
        progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
    if as_json:
        print_json(shown.json())
        return
    console = open_console()
    for name in shown.tables if shown.printed is None else shown.printed:
        console.print(lay_out(shown.tables[name]))
    for note in shown.notes:
        console.print(note, markup=False, highlight=False)
    for name in shown.files:
        if (run.path / name).exists():
            console.print(f"{name}: {run.path / name}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"run folder: {run.path}", highlight=False, markup=False, soft_wrap=True)
