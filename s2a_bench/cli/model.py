"""`model`: fetch model files, write dummy ones, say what is in them."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench import extras
from s2a_bench.cli.adapter import with_flags
from s2a_bench.cli.experiment import Commands
from s2a_bench.cli.output import console as open_console
from s2a_bench.cli.output import print_json

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from s2a_bench.inference.fetch import Fetched

SCHEMA = "s2a-bench-model/1"
"""Of `--json`; described by ``docs/schema/s2a-bench-model-1.json``."""


class ModelCommands(Commands):
    """The commands below and the experiments on a model alone."""

    group = "model"


app = typer.Typer(
    cls=ModelCommands, no_args_is_help=True, help="Fetch model files, write dummy ones, say what is in them."
)


class Size(str, Enum):
    """Values of --size."""

    tiny = "tiny"
    full = "full"


class Quant(str, Enum):
    """Values of --quant."""

    f16 = "f16"
    q8_0 = "q8_0"
    q4_0 = "q4_0"


@app.callback()
def model() -> None:
    """Fetch model files, write dummy ones, say what is in them."""


@app.command()
def fetch(
    what: Annotated[str, typer.Argument(metavar="NAME", help="minicpm-v-2.6, or ORG/REPO:FILE")],
    quant: Annotated[
        str | None, typer.Option(help="quantisation of the language model, as Q8_0  [default: Q4_K_M]")
    ] = None,
    mmproj: Annotated[
        str | None, typer.Option(help="the repository's vision tower to fetch too  [default: the known one, or none]")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Fetch a model from the hub: resumed where it broke off, checked against the hub's SHA-256."""
    from s2a_bench.inference.fetch import fetch as fetch_files
    from s2a_bench.inference.fetch import wanted
    from s2a_bench.inference.gguf_file import read_header

    for module in ("huggingface_hub", "gguf"):
        extras.need(module, "model")
    want = wanted(what, quant, mmproj)
    with _bytes_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(name: str, there: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name)
            bar.update(tasks[name], completed=there, total=total)

        done = fetch_files(want, show)
    for file in done.files:
        read_header(file.path, "model fetch")
    command = _latency_command(done)
    if json_:
        print_json(_fetched_json(done, command))
        return
    for file in done.files:
        typer.echo(file.path)
    if command:
        typer.echo(command)


def _latency_command(done: Fetched) -> str | None:
    """Return the command that measures with these files; None where they are no language model with its mmproj."""
    from shlex import join

    from s2a_bench.errors import ModelError
    from s2a_bench.inference import EngineConfig
    from s2a_bench.inference.models import load_headers

    model, *mmproj = (file.path for file in done.files)
    try:
        files = load_headers(EngineConfig(model=model, mmproj=mmproj[0] if mmproj else None))
    except ModelError as error:
        typer.echo(f"note: {with_flags(str(error))}", err=True)
        return None
    return join(["s2a-bench", "latency", "--model", str(files.model.path), "--mmproj", str(files.mmproj.path)])


def _fetched_json(done: Fetched, command: str | None) -> dict[str, Any]:
    files = [
        {"path": str(file.path), "bytes": file.nbytes, "sha256": file.sha256, "resumed_at": file.resumed_at}
        for file in done.files
    ]
    facts = {"endpoint": done.endpoint, "repository": done.repository, "commit": done.commit, "files": files}
    return {"schema": SCHEMA, "command": "model fetch", **facts} | ({"latency": command} if command else {})


@app.command()
def info(
    what: Annotated[str, typer.Argument(metavar="FILE", help="a GGUF file, or minicpm-v-2.6 once it is fetched")],
    hash_: Annotated[
        bool, typer.Option("--hash", help="compute the SHA-256; else it is shown where it is known already")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="one JSON object on standard output")] = False,
) -> None:
    """Say what is in a GGUF file: shapes, types, vision tower, vocabulary, chat template, licence, hash."""
    from s2a_bench.cli.model_text import as_json, renderables
    from s2a_bench.inference.fetch_names import HUB_MODELS, fetched
    from s2a_bench.inference.gguf_info import describe
    from s2a_bench.inference.models import remembered_sha256, sha256

    known = what in HUB_MODELS and not Path(what).is_file()
    paths = fetched(what, "model info") if known else (Path(what),)
    found = [(describe(path, "model info"), sha256(path) if hash_ else remembered_sha256(path)) for path in paths]
    if json_:
        files = [as_json(facts, hash_known) for facts, hash_known in found]
        print_json({"schema": SCHEMA, "command": "model info", "files": files})
        return
    console = open_console()
    for facts, hash_known in found:
        for part in renderables(facts, hash_known):
            console.print(part, soft_wrap=isinstance(part, str), highlight=False, markup=False)


def _bytes_bar(*, disable: bool = False) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    return Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), disable=disable)


@app.command()
def dummy(
    size: Annotated[Size, typer.Option(help="tiny: 13 MB, for tests; full: the shapes of MiniCPM-V 2.6")] = Size.tiny,
    quant: Annotated[
        Quant | None, typer.Option(help="type of the language model's weights  [default: f16 (tiny), q4_0 (full)]")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="folder to write to  [default: the user's cache folder]")] = None,
    force: Annotated[bool, typer.Option("--force", help="write the files again if they are there")] = False,
) -> None:
    """Write dummy weights: MiniCPM-V 2.6's architecture with random numbers, to measure speed without a download."""
    from s2a_bench.inference.dummy import dummy_files, write_dummy
    from s2a_bench.inference.models import dummy_folder

    kind = quant or (Quant.q4_0 if size is Size.full else Quant.f16)
    folder = output or dummy_folder(size.value)
    files = dummy_files(folder, size.value, kind.value)
    if force or not (files.model.is_file() and files.mmproj.is_file()):
        with _bytes_bar(disable=size is Size.tiny) as bar:
            task = bar.add_task("write", total=None)
            write_dummy(
                folder,
                size.value,
                kind.value,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
    typer.echo(files.model)
    typer.echo(files.mmproj)
