"""The command of an experiment: its options become flags, it runs, and what its run shows is written and printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup

from s2a_bench.cli.adapter import build, command, flags_named
from s2a_bench.cli.output import Json, print_json
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import shown as shown_line
from s2a_bench.errors import S2AError
from s2a_bench.experiments import EXPERIMENTS

if TYPE_CHECKING:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments import Experiment, Shown
    from s2a_bench.options import Options
    from s2a_bench.store.run import Run

PLAIN: dict[str, Any] = {"rich_markup_mode": None, "pretty_exceptions_enable": False, "add_completion": False}
"""How our commands look."""


class Commands(TyperGroup):
    """The commands of one group: those by hand, those in ``lazy``, and the experiments.

    What is not by hand is imported when it is looked up. The experiment `model validity` belongs to the group `model`.
    """

    group: ClassVar[str] = ""
    lazy: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """Name of a command -> its function or group, as "module:attribute", and what its help says."""

    @property
    def _experiments(self) -> dict[str, str]:
        """Return the experiments of this group by their commands."""
        words = ((name.rpartition(" "), name) for name in EXPERIMENTS)
        return {command: name for (group, _, command), name in words if group == self.group}

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands."""
        return sorted({*super().list_commands(ctx), *self.lazy, *self._experiments})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, made from its declaration when it is first asked for."""
        found = super().get_command(ctx, cmd_name)
        if found is None and (made := self._made(cmd_name)) is not None:
            if not isinstance(made, typer.Typer):
                single = typer.Typer(**PLAIN)
                single.command(cmd_name, help=self.lazy.get(cmd_name, ("", None))[1])(made)
                made = single
            found = self.commands[cmd_name] = typer.main.get_command(made)
            found.name = cmd_name
        return found

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List every command with its sentence, without importing what experiments are made of."""
        mine = {name: command for command, name in self._experiments.items()}
        abouts = {mine[name]: experiment.about for name, experiment in EXPERIMENTS.loaded() if name in mine}
        abouts |= {name: about for name, (_, about) in self.lazy.items()}
        for name in {*self.list_commands(ctx)}.difference(mine.values(), abouts):
            abouts[name] = self.get_command(ctx, name).get_short_help_str(limit=150)
        with formatter.section("Commands"):
            formatter.write_dl(sorted(abouts.items()))

    def _made(self, name: str) -> Any:
        if name in self.lazy:
            return resolve_name(self.lazy[name][0])
        return command_of(EXPERIMENTS[self._experiments[name]]) if name in self._experiments else None


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

    def run(
        config: Any,
        *view: Any,
        output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
        data_only: Annotated[
            bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
        ] = False,
        json_: Json = False,
    ) -> None:
        asked = view[0].model_dump() if view else {}
        _run(experiment, config, output, asked, data_only=data_only, as_json=json_)

    return command(run, *options_of(experiment), about=experiment.about)


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
        console.print(lay_out(shown.narrow.get(name) or shown.tables[name]))
    for note in (*shown.notes, run.origins.line):
        console.print(shown_line(note), markup=False, highlight=False)
    for name in shown.files:
        if (run.path / name).exists():
            console.print(f"{name}: {run.path / name}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"run folder: {run.path}", highlight=False, markup=False, soft_wrap=True)
