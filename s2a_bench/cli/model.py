"""`model`: list models, fetch their files, and write dummy ones."""

from __future__ import annotations

import shlex
from pathlib import Path

import typer

from s2a_bench import extras
from s2a_bench.cli.adapter import command, with_flags
from s2a_bench.cli.experiment import PLAIN, Commands
from s2a_bench.cli.output import Json, print_json, print_line, print_table
from s2a_bench.errors import ModelError
from s2a_bench.inference import DummyConfig, EngineConfig, FetchConfig
from s2a_bench.inference.gguf_file import read_header
from s2a_bench.store.manifest import present
from s2a_bench.writers.tables import TextTable

SCHEMA = "s2a-bench-model/1"

app = typer.Typer(cls=Commands, help="List models, fetch their files, and write dummy ones.", **PLAIN)


@app.command("list")
def list_(json_: Json = False) -> None:
    """List the known models and those on this machine, with the tokens that a picture costs."""
    from s2a_bench.inference.model_list import listed

    extras.need("model", "huggingface_hub", "gguf")
    models = [*listed()]
    if json_:
        print_json({"schema": SCHEMA, "command": "model list", "models": [*map(present, models)]})
        return
    rows: list[tuple[str, ...]] = []
    for model in models:
        name = model.name.rpartition("/")[2] if model.name.startswith("/") else model.name
        parameters = f"{model.parameters / 1e6:,.0f}" if model.parameters else ""
        sizes = " + ".join(f"{size / 1e6:,.1f}" for size in model.bytes.values())
        rows.append((name, model.state, parameters, sizes, str(model.picture_tokens or "")))
    header = "name", "state", "parameters (M)", "files (MB)", "tokens of a 640x480 picture"
    print_table(TextTable("Models", header, rows, 2))
    for model in filter(lambda each: each.error, models):
        print_line(f"{model.name}: {model.error}")


def _fetch(config: FetchConfig, *, json_: Json = False) -> None:
    from s2a_bench.inference.fetch import fetch

    extras.need("model", "huggingface_hub", "gguf")
    fetched = fetch(config)
    paths = [file.path for file in fetched.files]
    for path in paths:
        read_header(path, "model fetch")
    latency = _latency_command(*paths)
    if json_:
        whole = {"schema": SCHEMA, "command": "model fetch"} | present(fetched)
        print_json(whole | ({"latency": latency} if latency else {}))
        return
    for line in (*paths, *filter(None, [latency])):
        typer.echo(line)


def _latency_command(model: Path, mmproj: Path | None = None) -> str | None:
    """Return the command that measures with these files; None if they are not those of a model."""
    from s2a_bench.inference.models import load_headers

    try:
        files = load_headers(EngineConfig(model=model, mmproj=mmproj))
    except ModelError as error:
        typer.echo(f"note: {with_flags(str(error))}", err=True)
        return None
    if not files.mmproj:
        typer.echo("note: without an mmproj a model sees no picture; --mmproj FILE fetches one too", err=True)
    tower = ["--mmproj", str(files.mmproj.path)] if files.mmproj else []
    return shlex.join(["s2a-bench", "latency", "--model", str(files.model.path), *tower])


def _dummy(config: DummyConfig) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from s2a_bench.inference.dummy import dummy_files, write_dummy
    from s2a_bench.inference.models import dummy_folder

    folder = config.output or dummy_folder(config.size, config.like)
    files = dummy_files(folder, config.size, config.kind, like=config.like)
    if config.force or not (files.model.is_file() and files.mmproj.is_file()):
        with Progress(console=Console(stderr=True), disable=config.size == "tiny") as bar:
            task = bar.add_task("write", total=None)

            def show(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            write_dummy(folder, config.size, config.kind, progress=show, like=config.like)
    typer.echo(files.model)
    typer.echo(files.mmproj)


_ABOUT_FETCH = "Fetch a model from the hub, and check it against the hub's SHA-256."
app.command("fetch")(command(_fetch, FetchConfig, about=_ABOUT_FETCH))
_ABOUT_DUMMY = "Write random weights in the shapes of a model, to measure speed."
app.command("dummy")(command(_dummy, DummyConfig, about=_ABOUT_DUMMY))
