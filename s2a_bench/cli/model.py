"""`model`: fetch model files, write dummy ones, say what is in them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from s2a_bench import extras
from s2a_bench.cli.adapter import command, with_flags
from s2a_bench.cli.experiment import PLAIN, Commands
from s2a_bench.cli.output import Json, print_json
from s2a_bench.cli.output import console as open_console
from s2a_bench.inference.files_config import DummyConfig, FetchConfig, InfoConfig

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from s2a_bench.inference.fetch import Fetched

SCHEMA = "s2a-bench-model/1"
"""Of `--json`; described by ``docs/schema/s2a-bench-model-1.json``."""


class ModelCommands(Commands):
    """The commands below and the experiments on a model alone."""

    group = "model"


app = typer.Typer(
    cls=ModelCommands, no_args_is_help=True, help="Fetch model files, write dummy ones, say what is in them.", **PLAIN
)


def _fetch(config: FetchConfig, *, json_: Json = False) -> None:
    from s2a_bench.inference.fetch import fetch as fetch_files
    from s2a_bench.inference.fetch import wanted
    from s2a_bench.inference.gguf_file import read_header

    extras.need("model", "huggingface_hub", "gguf")
    want = wanted(config.what, config.quant, config.mmproj)
    with _bytes_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(name: str, there: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name)
            bar.update(tasks[name], completed=there, total=total)

        done = fetch_files(want, show)
    for file in done.files:
        read_header(file.path, "model fetch")
    latency = _latency_command(done)
    if json_:
        print_json(_fetched_json(done, latency))
        return
    for file in done.files:
        typer.echo(file.path)
    if latency:
        typer.echo(latency)


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


def _fetched_json(done: Fetched, latency: str | None) -> dict[str, Any]:
    from s2a_bench.inference.files_json import fetched_json

    files = [fetched_json(file) for file in done.files]
    facts = {"endpoint": done.endpoint, "repository": done.repository, "commit": done.commit, "files": files}
    return {"schema": SCHEMA, "command": "model fetch", **facts} | ({"latency": latency} if latency else {})


def _info(config: InfoConfig, *, json_: Json = False) -> None:
    from s2a_bench.cli.model_text import renderables
    from s2a_bench.inference.fetch_names import HUB_MODELS, fetched
    from s2a_bench.inference.files_json import info_json
    from s2a_bench.inference.gguf_info import describe
    from s2a_bench.inference.models import remembered_sha256, sha256

    what = config.what
    known = what in HUB_MODELS and not Path(what).is_file()
    paths = fetched(what, "model info") if known else (Path(what),)
    found = [(describe(path, "model info"), sha256(path) if config.hash else remembered_sha256(path)) for path in paths]
    if json_:
        files = [info_json(facts, hash_known) for facts, hash_known in found]
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


def _dummy(config: DummyConfig) -> None:
    from s2a_bench.inference.dummy import dummy_files, write_dummy
    from s2a_bench.inference.models import dummy_folder

    folder = config.output or dummy_folder(config.size)
    files = dummy_files(folder, config.size, config.kind)
    if config.force or not (files.model.is_file() and files.mmproj.is_file()):
        with _bytes_bar(disable=config.size == "tiny") as bar:
            task = bar.add_task("write", total=None)

            def show(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            write_dummy(folder, config.size, config.kind, progress=show)
    typer.echo(files.model)
    typer.echo(files.mmproj)


for _name, _function, _config, _about in (
    ("fetch", _fetch, FetchConfig, "Fetch a model from the hub: resumed, and checked against the hub's SHA-256."),
    ("info", _info, InfoConfig, "Say what is in a GGUF file: shapes, types, vision tower, vocabulary, licence, hash."),
    ("dummy", _dummy, DummyConfig, "Write weights of random numbers in MiniCPM-V 2.6's shapes, to measure speed with."),
):
    app.command(_name)(command(_function, _config, about=_about))
