"""`s2a-bench profile`: measure this machine as a hardware profile, and look at those there are."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.options import engine_config, size_of, text_or_file
from s2a_bench.cli.output import console as open_console
from s2a_bench.errors import UsageError
from s2a_bench.frames import SOURCES

if TYPE_CHECKING:
    from s2a_bench.boards.profile import Profile

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, add_completion=False)

SCHEMA = "s2a-bench-profile/1"
"""Of `--json`; described by ``docs/schema/s2a-bench-profile-1.json``."""

Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output")]


@app.command("capture")
def capture(
    name: Annotated[str, typer.Argument(help="name of the profile; its file is NAME.toml")],
    title: Annotated[str, typer.Option(help="what figures call it [default: the board's or CPU's name]")] = "",
    model: Annotated[Path | None, typer.Option(help="GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[Path | None, typer.Option(help="GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads of the model; 0: all")] = 0,
    gpu_layers: Annotated[int, typer.Option(min=-1, help="model layers on the GPU; -1: all")] = 0,
    context: Annotated[int, typer.Option(min=256, help="context length in tokens")] = 4096,
    source: Annotated[str, typer.Option(help=f"{', '.join(SOURCES)}, as video:FILE")] = "synthetic",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the frames")] = "640x480",
    requests: Annotated[int, typer.Option(help="requests that count, each about a new frame")] = 20,
    warmup: Annotated[int, typer.Option(help="requests before them, kept in the file and left out")] = 3,
    tokens: Annotated[int, typer.Option(help="most tokens an answer")] = 64,
    prompt: Annotated[str | None, typer.Option(help="text, or @FILE [default: the paper's prompt]")] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the frames and the sampling")] = 0,
    output: Annotated[Path, typer.Option(help="folder for the file")] = Path("profiles"),
    force: Annotated[bool, typer.Option("--force", help="replace a profile of this name")] = False,
    json_: Json = False,
) -> None:
    """Measure this machine: rate, time to first token and every gap between tokens, for other machines to replay."""
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.experiments.profile_capture.run import CaptureConfig, make_room, write_profile
    from s2a_bench.experiments.profile_capture.run import capture as measure
    from s2a_bench.harness.plan import DEFAULT_PROMPT

    width, height = size_of(size)
    text = DEFAULT_PROMPT if prompt is None else text_or_file(prompt)
    engine = engine_config(
        name="llama", model=model, mmproj=mmproj, threads=threads, gpu_layers=gpu_layers, context=context
    )
    config = CaptureConfig(name, engine, source, width, height, requests, warmup, tokens, text, seed)
    config.check()
    path = output / f"{name}.toml"
    make_room(path, force=force)
    with RunProgress() as progress:
        progress.expect(requests + warmup)
        tables = measure(config, progress.stage, progress.advance)
        for warning in tables["capture"]["warnings"]:
            progress.say(f"warning: {warning}")
    profile = write_profile({**tables, **({"title": title} if title else {})}, path, force=force)
    if json_:
        _print_json("capture", [_facts(profile, path)])
        return
    _print(_line(profile))
    _print(f"gaps: {profile.facts['fit']['family']}, the nearest of {_distances(profile)}")
    _print(f"profile: {path}")


@app.command("list")
def list_(json_: Json = False) -> None:
    """List the profiles that can be given by name; a wrong file is named on standard error."""
    from rich.table import Table
    from rich.text import Text

    found = _readable()
    if json_:
        _print_json("list", [_facts(profile, path) for profile, path in found])
        return
    table = Table(box=None, pad_edge=False)
    for header in ("name", "board", "origin"):
        table.add_column(header, no_wrap=header != "board")
    for header in ("tokens/s", "TTFT s"):
        table.add_column(header, justify="right", no_wrap=True)
    table.add_column("gaps")
    for profile, _ in found:
        ttft = f"{_ttft_s(profile):.3g}" + (" (assumed)" if "prompt_s" in profile.assumed else "")
        origin = profile.origin + (", dummy" if _dummy(profile) else "")
        row = (profile.name, profile.title, origin, f"{profile.tokens_per_s:.3g}", ttft, _gaps(profile, full=False))
        table.add_row(*map(Text, row))
    open_console().print(table)


@app.command("show")
def show(name: Annotated[str, typer.Argument(help="a name of 'profile list', or a path")], json_: Json = False) -> None:
    """Show one profile: its numbers, where they are from, and what is known of board, model and fit."""
    from s2a_bench.boards.file import read_profile
    from s2a_bench.boards.search import find_profile

    path = find_profile(name)
    profile = read_profile(path)
    if json_:
        _print_json("show", [_facts(profile, path)])
        return
    _print(_line(profile))
    _print(f"file: {path}")
    if profile.assumed:
        _print(f"assumed, not from {profile.origin} data: {', '.join(profile.assumed)}")
    _print(f"spread: prompt CV {profile.prompt_cv:.3g}, rate CV from answer to answer {profile.rate_cv:.3g}")
    _print(f"gaps: {_gaps(profile)}")
    for table, facts in profile.facts.items():
        _print(f"{table}:")
        for key, value in facts.items():
            shown = " ".join(str(value).split())
            _print(f"  {key}: {shown}")


@app.command("match")
def match(json_: Json = False) -> None:
    """Say which profiles are of a board like this one; exit code 1 where none is."""
    from s2a_bench.machine.board import board_facts, differences, matches

    board = board_facts()
    found = [(profile, path) for profile, path in _readable() if matches(profile, board)]
    if json_:
        same = [{**_facts(profile, path), "differences": differences(profile, board)} for profile, path in found]
        _print_json("match", same, board=board)
    else:
        kind = ", ".join(str(board[key]) for key in ("model", "gpu", "cpu") if key in board)
        _print(f"this board: {kind}, {board['cores']} cores")
        for profile, _ in found:
            _print(_line(profile) + "".join(f"; {change}" for change in differences(profile, board)))
        if not found:
            _print("no profile is of this board; 's2a-bench profile capture NAME' measures one")
    if not found:
        raise typer.Exit(1)


def _readable() -> list[tuple[Profile, Path]]:
    """Read the profiles that can be given by name, and name those that cannot be read."""
    from s2a_bench.boards.file import read_profile
    from s2a_bench.boards.search import profile_files

    found = []
    for path in profile_files().values():
        try:
            found.append((read_profile(path), path))
        except UsageError as error:
            typer.echo(f"left out: {error}", err=True)
    return found


def _facts(profile: Profile, path: Path) -> dict[str, Any]:
    """Return a profile as plain data; the recording as its length."""
    from s2a_bench.boards.gaps import to_table

    plain = {key: value for key, value in asdict(profile).items() if key not in {"trace_s", "gaps"}}
    rest = {"file": str(path), "ttft_s": _ttft_s(profile), "dummy": _dummy(profile), "recorded": len(profile.trace_s)}
    return {**plain, **rest, "gaps": to_table(profile.gaps)}


def _ttft_s(profile: Profile) -> float:
    return profile.prompt_s + 1 / profile.tokens_per_s


def _dummy(profile: Profile) -> bool:
    return profile.facts.get("model", {}).get("dummy") is True


def _origin(profile: Profile) -> str:
    return profile.origin + (", dummy weights" if _dummy(profile) else "")


def _gaps(profile: Profile, *, full: bool = True) -> str:
    """Name the family, with its parameters where ``full``, and how many gaps were recorded."""
    from s2a_bench.boards.gaps import to_table

    table = to_table(profile.gaps)
    numbers = "".join(f" {key} {value:.3g}" for key, value in table.items() if full and isinstance(value, int | float))
    recorded = f", {len(profile.trace_s)} recorded" if profile.trace_s else ""
    assumed = ", assumed" if "gaps" in profile.assumed else ""
    return f"{table['family']}{numbers}{recorded}{assumed}"


def _line(profile: Profile) -> str:
    return (
        f"{profile.name}: {profile.title}, {profile.tokens_per_s:.4g} tokens/s, first token after "
        f"{_ttft_s(profile):.3g} s ({_origin(profile)})"
    )


def _distances(profile: Profile) -> str:
    fit = profile.facts["fit"]
    return ", ".join(f"{name} {max(gap, fit['distance_sum'][name]):.3f}" for name, gap in fit["distance_gap"].items())


def _print(line: str) -> None:
    typer.echo(line)


def _print_json(command: str, profiles: list[dict[str, Any]], **more: Any) -> None:
    whole = {"schema": SCHEMA, "command": f"profile {command}", **more, "profiles": profiles}
    json.dump(whole, sys.stdout, indent=2, ensure_ascii=False, allow_nan=False, default=str)
    sys.stdout.write("\n")
