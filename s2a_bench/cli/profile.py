"""`s2a-bench profile`: measure this machine as a hardware profile; list, show and match profiles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from s2a_bench.boards.gaps import to_table
from s2a_bench.boards.profile import Profile, find_profile, profile_files, read_profile
from s2a_bench.cli.adapter import command, with_flags
from s2a_bench.cli.experiment import PLAIN, Commands
from s2a_bench.cli.output import Json, print_json, print_table
from s2a_bench.errors import UsageError
from s2a_bench.experiments.profile_capture import CaptureConfig, profile_json, ttft_s
from s2a_bench.machine.environment import board_facts, matches, state_changes
from s2a_bench.store.manifest import plain
from s2a_bench.writers.tables import EMULATED, TextTable

app = typer.Typer(cls=Commands, help="Measure this machine as a hardware profile, and show profiles.", **PLAIN)
SCHEMA = "s2a-bench-profile/1"


@app.command("list")
def list_(json_: Json = False) -> None:
    """List the profiles that have a name; an unreadable file is named on standard error."""
    profiles = _readable()
    if json_:
        _print_profiles("list", [profile_json(profile, path) for profile, path in profiles])
        return
    rows: list[tuple[str, ...]] = []
    for profile, _ in profiles:
        ttft = f"{ttft_s(profile):.3g}" + (" (assumed)" if "prompt_s" in profile.assumed else "")
        origin = _origin(profile).replace(" weights", "")
        gaps, rate = _gaps(profile, full=False), f"{profile.tokens_per_s:.3g}"
        rows.append((profile.name, profile.title, origin, gaps, rate, ttft))
    print_table(TextTable("Profiles", ("name", "board", "origin", "gaps", "tokens/s", "TTFT s"), rows, 4))


@app.command("show")
def show(
    name: Annotated[
        str, typer.Argument(help="a name of 'profile list', or a path", autocompletion=lambda: [*profile_files()])
    ],
    json_: Json = False,
) -> None:
    """Show one profile: its numbers and their origin, and the facts of board, model and fit."""
    path = find_profile(name)
    profile = read_profile(path)
    if json_:
        _print_profiles("show", [profile_json(profile, path)])
        return
    typer.echo(line_of(profile))
    typer.echo(f"file: {path}")
    if profile.assumed:
        typer.echo(f"assumed, not from {profile.origin} data: {', '.join(profile.assumed)}")
    typer.echo(f"spread: prompt CV {profile.prompt_cv:.3g}, rate CV from answer to answer {profile.rate_cv:.3g}")
    typer.echo(f"gaps: {_gaps(profile)}")
    for table, facts in profile.facts.items():
        typer.echo(f"{table}:")
        for key, value in facts.items():
            typer.echo(f"  {key}: {' '.join(str(value).split())}")


@app.command("match")
def match(json_: Json = False) -> None:
    """List the profiles of boards of this kind; exit with 1 if there is none."""
    board = board_facts()
    profiles = [(profile, path) for profile, path in _readable() if matches(profile, board)]
    if json_:
        same = [profile_json(profile, path, state_changes(profile, board)) for profile, path in profiles]
        _print_profiles("match", same, board=board)
    else:
        kind = ", ".join(str(board[key]) for key in ("model", "gpu", "cpu") if key in board)
        typer.echo(f"this board: {kind}, {board['cores']} cores")
        for profile, _ in profiles:
            typer.echo(line_of(profile) + "".join(f"; {change}" for change in state_changes(profile, board)))
        if not profiles:
            typer.echo("no profile is of this board; 's2a-bench profile capture NAME' measures one")
    if not profiles:
        raise typer.Exit(1)


def _readable() -> list[tuple[Profile, Path]]:
    """Read the profiles that have a name; print the error of each unreadable one."""
    profiles = []
    for path in profile_files().values():
        try:
            profiles.append((read_profile(path), path))
        except UsageError as error:
            typer.echo(f"left out: {with_flags(str(error))}", err=True)
    return profiles


def _gaps(profile: Profile, *, full: bool = True) -> str:
    table = to_table(profile.gaps)
    numbers = "".join(f" {key} {value:.3g}" for key, value in table.items() if full and isinstance(value, int | float))
    recorded = f", {len(profile.trace_s)} recorded" if profile.trace_s else ""
    assumed = ", assumed" if "gaps" in profile.assumed else ""
    return f"{table['family']}{numbers}{recorded}{assumed}"


def _origin(profile: Profile) -> str:
    return ", ".join((profile.origin, *(label for label in profile.provenance.labels if label != EMULATED)))


def line_of(profile: Profile) -> str:
    rate = f"{profile.tokens_per_s:.4g} tokens/s, first token after {ttft_s(profile):.3g} s"
    return f"{profile.name}: {profile.title}, {rate} ({_origin(profile)})"


def _print_profiles(command: str, profiles: list[dict[str, Any]], **more: Any) -> None:
    print_json(plain({"schema": SCHEMA, "command": f"profile {command}", **more, "profiles": profiles}))


def _capture(
    config: CaptureConfig,
    *,
    output: Annotated[Path, typer.Option(help="folder for the file")] = Path("profiles"),
    force: Annotated[bool, typer.Option("--force", help="replace a profile of the same name")] = False,
    json_: Json = False,
) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.profile_capture.run import capture, prepare_file, write_profile

    path = output / f"{config.name}.toml"
    prepare_file(path, force=force)
    with RunProgress() as progress:
        tables = capture(config, progress)
        for warning in tables["capture"]["warnings"]:
            progress.say(f"warning: {warning}")
    profile = write_profile(tables, path, force=force)
    if json_:
        _print_profiles("capture", [profile_json(profile, path)])
        return
    fit = profile.facts["fit"]
    distances = {name: max(gap, fit["distance_sum"][name]) for name, gap in fit["distance_gap"].items()}
    typer.echo(line_of(profile))
    typer.echo(
        f"gaps: {fit['family']}, the nearest of {', '.join(f'{name} {gap:.3f}' for name, gap in distances.items())}"
    )
    typer.echo(f"profile: {path}")


_ABOUT = "Measure this machine: rate, time to first token and every gap between tokens, to be replayed elsewhere."
app.command("capture")(command(_capture, CaptureConfig, about=_ABOUT))
