"""The command of an experiment: it runs one, then writes and prints the tables and figures of the run."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

from s2a_bench.cli import output as terminal
from s2a_bench.cli.adapter import HELP_ALL, command
from s2a_bench.cli.output import Json, print_failures, print_json, print_line
from s2a_bench.errors import S2AError
from s2a_bench.experiments import EXPERIMENTS, Experiment, Shown, write_shown
from s2a_bench.text import like
from s2a_bench.writers.tables import fits, lay_out

if TYPE_CHECKING:
    from s2a_bench.options import Options
    from s2a_bench.store.run import StoredRun

PLAIN: dict[str, Any] = {"rich_markup_mode": None, "pretty_exceptions_enable": False, "add_completion": False}
ParseError: Any = typer.BadParameter.__mro__[1]
"""Click's UsageError, which newer typer brings with it, so that it cannot be imported by name."""


class Commands(TyperGroup):
    """The commands of one group; those in ``lazy`` and its ``experiments`` are imported when they are looked up."""

    experiments: ClassVar[Collection[str]] = ()
    lazy: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """Name of a command -> its function or group, as "module:attribute", and its help."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted({*super().list_commands(ctx), *self.lazy, *self.experiments})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in self.commands and cmd_name in self.lazy:
            where, about = self.lazy[cmd_name]
            self.commands[cmd_name] = _click(cmd_name, resolve_name(where), about)
        elif cmd_name not in self.commands and cmd_name in self.experiments:
            self.commands[cmd_name] = click_command(cmd_name)
        return super().get_command(ctx, cmd_name)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        parsed: list[str] = super().parse_args(ctx, args or ["--help"])
        return parsed

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        names = self.list_commands(ctx)
        if args[0] not in names and not args[0].startswith("-") and not ctx.resilient_parsing:
            ctx.fail(f"No such command '{args[0]}'{like(args[0], names)}")
        return super().resolve_command(ctx, args)

    def _abouts(self) -> dict[str, str]:
        """Return name -> help of every command, without importing the experiments."""
        abouts = {name: command.get_short_help_str(limit=150) for name, command in self.commands.items()}
        abouts |= {name: experiment.about for name, experiment in EXPERIMENTS.loaded() if name in self.experiments}
        return dict(sorted({**abouts, **{name: about for name, (_, about) in self.lazy.items()}}.items()))

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete names of commands without importing them; the process ends afterwards."""
        self.commands = {name: TyperCommand(name, help=about) for name, about in self._abouts().items()}
        return super().shell_complete(ctx, incomplete)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - Click's signature
        with formatter.section("Commands"):
            formatter.write_dl([*self._abouts().items()])


def _click(name: str, command: Any, about: str | None = None) -> Any:
    group = command
    if not isinstance(command, typer.Typer):
        group = typer.Typer(**PLAIN)
        group.command(name, help=about, cls=Flagged)(command)
    click: Any = typer.main.get_command(group)
    click.name, click.rest = name, getattr(command, "rest", ())
    return click


class Flagged(TyperCommand):
    """A command with many flags: its help has them under headings, and only the `first` ones without --help-all."""

    rest: Collection[str] = ()

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """List the flags under their headings in the order of declaration, those without a heading last."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for each in sorted(self.get_params(ctx), key=lambda each: each.name == HELP_ALL):
            record = each.get_help_record(ctx)
            if record and (HELP_ALL in ctx.meta or each.name not in self.rest):
                panel = "Arguments" if each.param_type_name == "argument" else getattr(each, "rich_help_panel", "")
                panels.setdefault(panel or "", []).append(record)
        panels["Options"] = panels.pop("", [])
        width = max(len(flag) for records in panels.values() for flag, _ in records)
        for panel, records in panels.items():
            if records:
                with formatter.section(panel):
                    formatter.write_dl([(flag.ljust(width), about) for flag, about in records])


@cache
def click_command(name: str) -> Any:
    return _click(name, command_of(EXPERIMENTS[name]))


def options_of(experiment: Experiment) -> tuple[type[Options] | Experiment, ...]:
    """Return what declares an experiment's options: of the run, itself if it has modes; and of its view."""
    run = experiment if experiment.modes else resolve_name(experiment.config)
    return (run, resolve_name(experiment.view_options)) if experiment.view_options else (run,)


def command_of(experiment: Experiment) -> Callable[..., None]:
    def run(
        config: Any,
        *view: Any,
        output: Annotated[Path, typer.Option(help="folder for run folders")] = Path("results"),
        data_only: Annotated[
            bool, typer.Option("--data-only", help="write no tables and figures into the run folder")
        ] = False,
        verbose: Annotated[
            bool,
            typer.Option("--verbose", help="also print the other tables, the cost of measuring, the environment"),
        ] = False,
        json_: Json = False,
    ) -> None:
        from s2a_bench.cli.progress import RunProgress
        from s2a_bench.store.run import read_run

        progress = RunProgress(experiment.unit)
        try:
            with progress:
                kept = read_run(experiment.run_with(config, output, progress))
                shown = experiment.show(kept, **(view[0].model_dump() if view else {}))
                if not data_only:
                    progress.stage("drawing")
                    write_shown(kept, shown)
            for warning in kept.manifest["warnings"]:
                progress.say(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
            if json_:
                with shown.noted("--json"):
                    print_json(shown.json())
            else:
                present(kept, shown, verbose=verbose)
        except (S2AError, KeyboardInterrupt):
            if progress.folder is not None and progress.folder.exists():
                progress.say(f"{experiment.unit} so far: {progress.folder}")
            raise
        print_failures((kept.path, shown.failures))

    return command(run, *options_of(experiment), about=experiment.about)


def present(run: StoredRun, shown: Shown, *, verbose: bool = False) -> None:
    """Print the main table, or every table if ``verbose``, the sentences and notes, and the paths of the files."""
    console = terminal.console()
    first = [*(shown.main[:1] or shown.tables)]
    names = [*dict.fromkeys((*first, *shown.tables))] if verbose else first
    rest = [name for name in shown.tables if name not in names]
    notes: dict[str, None] = {}
    for name in names:
        table = shown.tables[name]
        if not verbose and table.brief and not fits(table, console.width):
            rest.append(f"{name} in full")
            table = table.brief
        console.print(lay_out(table, console.width))
        notes |= dict.fromkeys(table.notes)
    details = _details(run.manifest) if verbose else ()
    for line in filter(None, (*shown.sentences, " ".join(notes), *details, run.origins.line)):
        console.print(terminal.shown(line), markup=False, highlight=False)
    if rest:
        written = f"{run.path / 'tables'}; " if (run.path / "tables").exists() else ""
        print_line(f"more tables ({', '.join(rest)}): {written}--verbose prints them")
    print_line(f"run folder: {run.path}")


def _details(manifest: Mapping[str, Any]) -> Iterator[str]:
    if "mark_cost_ns" in manifest:
        yield f"a mark costs {manifest['mark_cost_ns']} ns"
    if sampled := manifest.get("resources"):
        share, edge_us = sampled["core_share"] or 0, sampled["edge_us"]
        yield f"sampling takes {share:.2%} of a core, and {edge_us} us before and after each request"
    yield from json.dumps(manifest["environment"], indent=2, ensure_ascii=False).splitlines()
