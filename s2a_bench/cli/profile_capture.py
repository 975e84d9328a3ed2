"""`s2a-bench profile capture`: measure this machine as a hardware profile."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.profile import Json, distances, facts_of, line_of, print_profiles
from s2a_bench.cli.progress import RunProgress
from s2a_bench.experiments.profile_capture.config import CaptureConfig


def _capture(
    config: CaptureConfig,
    *,
    output: Annotated[Path, typer.Option(help="folder for the file")] = Path("profiles"),
    force: Annotated[bool, typer.Option("--force", help="replace a profile of this name")] = False,
    json_: Json = False,
) -> None:
    from s2a_bench.experiments.profile_capture.run import capture, make_room, write_profile

    path = output / f"{config.name}.toml"
    make_room(path, force=force)
    with RunProgress() as progress:
        tables = capture(config, progress)
        for warning in tables["capture"]["warnings"]:
            progress.say(f"warning: {warning}")
    profile = write_profile(tables, path, force=force)
    if json_:
        print_profiles("capture", [facts_of(profile, path)])
        return
    typer.echo(line_of(profile))
    typer.echo(f"gaps: {profile.facts['fit']['family']}, the nearest of {distances(profile)}")
    typer.echo(f"profile: {path}")


capture = command(
    _capture,
    CaptureConfig,
    about="Measure this machine: rate, time to first token and every gap between tokens, for other machines to replay.",
)
