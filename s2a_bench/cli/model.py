"""`model`: get model files ready."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Get model files ready.")


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
    """Get model files ready."""


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
        from rich.console import Console
        from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

        columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), disable=size is Size.tiny) as bar:
            task = bar.add_task("write", total=None)
            write_dummy(
                folder,
                size.value,
                kind.value,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
    typer.echo(files.model)
    typer.echo(files.mmproj)
