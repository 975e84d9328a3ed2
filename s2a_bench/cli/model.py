"""`model`: fetch model files, write dummy ones, and show what is in them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from s2a_bench import extras
from s2a_bench.cli.adapter import command, with_flags
from s2a_bench.cli.experiment import PLAIN, Commands
from s2a_bench.cli.output import Json, print_json, print_table
from s2a_bench.errors import ModelError
from s2a_bench.inference import DummyConfig, EngineConfig, FetchConfig, InfoConfig
from s2a_bench.inference.gguf_file import GgufInfo, Vocabulary, describe, read_header
from s2a_bench.store.manifest import present
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from s2a_bench.inference.fetch import Fetched

SCHEMA = "s2a-bench-model/1"
_TEMPLATE_CHARACTERS = 300
_CONTROL_TOKENS = 24

app = typer.Typer(cls=Commands, help="Fetch model files, write dummy ones, and show their contents.", **PLAIN)


def _fetch(config: FetchConfig, *, json_: Json = False) -> None:
    from s2a_bench.inference import fetch

    extras.need("model", "huggingface_hub", "gguf")
    wanted = fetch.wanted(config.what, config.quant, config.mmproj)
    with _bytes_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name)
            bar.update(tasks[name], completed=done, total=total)

        fetched = fetch.fetch(wanted, show)
    for file in fetched.files:
        read_header(file.path, "model fetch")
    latency = _latency_command(fetched)
    if json_:
        names = "endpoint", "repository", "commit"
        whole: dict[str, Any] = {"schema": SCHEMA, "command": "model fetch"}
        whole |= {name: getattr(fetched, name) for name in names} | {"files": [*map(present, fetched.files)]}
        print_json(whole | ({"latency": latency} if latency else {}))
        return
    for file in fetched.files:
        typer.echo(file.path)
    if latency:
        typer.echo(latency)


def _latency_command(fetched: Fetched) -> str | None:
    """Return the command that measures with these files; None unless they are a language model with its mmproj."""
    from s2a_bench.inference.models import load_headers

    model, *mmproj = (file.path for file in fetched.files)
    try:
        files = load_headers(EngineConfig(model=model, mmproj=mmproj[0] if mmproj else None))
    except ModelError as error:
        typer.echo(f"note: {with_flags(str(error))}", err=True)
        return None
    return shlex.join(["s2a-bench", "latency", "--model", str(files.model.path), "--mmproj", str(files.mmproj.path)])


def _info(config: InfoConfig, *, json_: Json = False) -> None:
    from s2a_bench.inference.models import HUB_MODELS, fetched, remembered_sha256, sha256

    what = config.what
    known = what in HUB_MODELS and not Path(what).is_file()
    paths = fetched(what, "model info") if known else (Path(what),)
    hash_of = sha256 if config.hash else remembered_sha256
    found = [describe(path, "model info", hash_of) for path in paths]
    if json_:
        print_json({"schema": SCHEMA, "command": "model info", "files": [present(info) for info in found]})
        return
    for info in found:
        for section in info_sections(info):
            typer.echo(section) if isinstance(section, str) else print_table(section)


def _bytes_bar(*, disable: bool = False) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
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
    ("fetch", _fetch, FetchConfig, "Fetch a model from the hub: resumable, checked against the hub's SHA-256."),
    ("info", _info, InfoConfig, "Show what is in a GGUF file: shapes, types, vision tower, vocabulary, licence, hash."),
    ("dummy", _dummy, DummyConfig, "Write random weights in the shapes of MiniCPM-V 2.6, to measure speed."),
):
    app.command(_name)(command(_function, _config, about=_about))


def info_sections(info: GgufInfo) -> list[str | TextTable]:
    """Return the texts and tables of a file, in the order of printing."""
    types: list[tuple[str, ...]] = []
    for each in info.types:
        bits = f"{each.bytes * 8 / each.parameters:.2f}" if each.parameters else ""
        types.append((each.kind, str(each.tensors), f"{each.parameters:,}", f"{each.bytes / 1e6:,.1f}", bits))
    groups: list[tuple[str, ...]] = []
    for group in info.groups:
        shape, megabytes = " x ".join(map(str, group.shape)), f"{group.bytes / 1e6:,.1f}"
        groups.append((_clean(group.name), shape, ", ".join(group.kinds), str(group.tensors), megabytes))
    sections: list[str | TextTable] = [
        "\n".join(_head(info)),
        TextTable("weights by type", ("type", "tensors", "parameters", "MB", "bits/weight"), types, 1),
        TextTable("weights by tensor (N: the layer)", ("tensor", "shape", "type", "tensors", "MB"), groups, 3),
        "settings: " + _clean(_pairs(info.settings)),
    ]
    if info.vocabulary is not None:
        sections.append("\n".join(_vocabulary(info.vocabulary, info.tokenizer)))
    if info.chat_template is not None:
        text, cut = info.chat_template, len(info.chat_template) > _TEMPLATE_CHARACTERS
        more = f" ... ({len(text)} characters; --json has all of them)" if cut else ""
        sections.append(f"chat template: {text[:_TEMPLATE_CHARACTERS]!r}{more}")
    return sections


def _pairs(facts: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in facts.items())


def _clean(text: object) -> str:
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in str(text))


def _head(info: GgufInfo) -> list[str]:
    kind = "mmproj (vision tower and projector)" if info.mmproj else "language model"
    size = f"{info.bytes / 1e9:.3f} GB, {info.parameters:,} parameters, GGUF version {info.gguf_version}"
    return [
        f"{info.path}",
        f"{kind}, architecture {_clean(info.architecture) or 'not given'}" + (", DUMMY WEIGHTS" if info.dummy else ""),
        *(f"{key}: {_clean(value)}" for key, value in info.general.items()),
        size + (f", file type {info.file_type}" if info.file_type else ""),
        f"sha256: {info.sha256}" if info.sha256 else "sha256: not computed; --hash computes it",
    ]


def _vocabulary(vocabulary: Vocabulary, tokenizer: dict[str, Any]) -> list[str]:
    special = ", ".join(f"{role} {token.id} {token.text!r}" for role, token in vocabulary.special.items())
    control = vocabulary.control
    more = f" ... ({len(control)} in all)" if len(control) > _CONTROL_TOKENS else ""
    return [
        f"vocabulary: {vocabulary.tokens} tokens, {vocabulary.merges} merges; tokeniser {_clean(_pairs(tokenizer))}",
        f"special tokens: {special or 'none named'}",
        f"control tokens: {_clean(' '.join(control[:_CONTROL_TOKENS])) or 'none'}{more}",
    ]
