"""Write runs as folders to share, each with the fields of an allow-list (docs/share.md).

Of a manifest the keys of `ExportedRun` leave: numbers everywhere below them, texts under the keys of `TEXTS`. Of a
table numbers leave, and the texts of `COLUMNS`. Paths, addresses, and names of hosts and users are removed from these
texts; equal ones have equal placeholders, so rows and manifest still fit.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import StoreError, UsageError
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.inference import ENGINES
from s2a_bench.machine.resources import SPENT
from s2a_bench.provenance import Provenance
from s2a_bench.store import files
from s2a_bench.store import manifest as manifests
from s2a_bench.store.export import FORMAT, KEY, TABLE, WITHHELD, ExportedFile, ExportedRun, tables_in
from s2a_bench.store.run import StoredRun, fits, read_run
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.store.sweep import is_sweep, read_sweep
from s2a_bench.trace import STAGES
from s2a_bench.transport import TRANSPORTS

_TEXTS: Final = """
s2a_bench kernel machine python cpu governor clock_source board power_mode name driver ROS_DISTRO ROS_DOMAIN_ID
ROS_AUTOMATIC_DISCOVERY_RANGE RMW_IMPLEMENTATION nonce dds unit about what
engine model_sha256 mmproj_sha256 quantisation architecture projector model_type kv_type flash_attention
llama_cpp_python sampling answer latency profile gaps prompt_origin title origin family guarantee asked chosen
command mode payload size observation policies policy modes rules rounding simulator robot time transports request_id
connection dialect qos dds_tuning middleware template layout llama_server follower gap jitter load limit service link
transport skills orders outcome env success stall period study cadence follower_law weights tokens clock profiles robots
"""
TEXTS: Final = frozenset(_TEXTS.split())
"""The keys whose text leaves, alone or in a list."""
MAPS: Final = frozenset({"stages", "service", "variants"})
"""The keys of mappings whose texts leave."""
HASHED: Final = frozenset({"prompt"})
"""The keys of texts whose checksum leaves, as runs with different ones are not alike."""
_COLUMNS: Final = """
cell pipeline variant payload connection engine mode size request_id used_by marks facts policy board title study
simulator follower gap_behaviour outcome phase source verdict limit rule latency rounding duration family reader
provenance
"""
COLUMNS: Final = frozenset(_COLUMNS.split())
"""The columns whose text leaves."""
HIDDEN: Final = frozenset({"token_id"})
"""Columns of numbers from which a model's text can be restored."""

_PLAIN: Final = "withheld localhost none home jetson nvidia ubuntu"
"""Words that identify nothing, even if a host has such a name, as the words of stages, facts and keys."""
_PASSES: Final = 3
"""What one pass leaves beside a placeholder may be a path or an address."""
_LONG: Final = 8
"""A shorter name of a host or user is removed as a separate word only."""
_TIME: Final = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00")
_NUMBER: Final = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?|true|false")
_CODE: Final = re.compile(r"[a-z0-9-]+")
_HASH: Final = re.compile(rf"{WITHHELD}, SHA-256 [0-9a-f]{{16}}")
_VERSION: Final = re.compile(r"\d+(\.\d+){1,3}([.+-]?[A-Za-z]\w*)*")
_NAME: Final = re.compile(r"[\w.-]*[A-Za-z][\w.-]*")
_AT: Final = r"@(?=[A-Za-z\[]|\d+\.\d+\.\d)"
_NAMED: Final = re.compile(
    r"[/\\](?:home|users)[/\\]+([^/\\\s\"',;)]+)|~([\w-]+)"
    rf"|([\w.-]+){_AT}|(?:://(?:[^/@\s]*@)?|\w@)({_NAME.pattern})",
    re.IGNORECASE,
)
"""Users by their home folders, users and hosts by addresses."""
_PLACES: Final = (
    r"(?<![a-z0-9+.-])[a-z][a-z0-9+.-]*://[^\s\"',;)]*",
    rf"(?<![\w.+-])[\w.+-]+{_AT}[^\s\"',;)]*",
    r"(?<![0-9a-z])(?:[0-9a-f]{0,4}:){2,7}[0-9a-f]{0,4}(?![0-9a-z])",  # IPv6, MAC
    r"(?<!\d)\d{1,3}(?:\.\d{1,3}){3}(?!\d)",
    r"(?<!\w)(?:[a-z]:|~[\w-]*|\.{1,2})?[/\\]+[^\s\"',;)/\\][^\"',;)\n]*",
    r"[/\\]+(?:home|users)[/\\][^\"',;)\n]*",
    r"(?<![\w.~/\\-])[\w.~-]+(?:[/\\][\w.~-]+)*[/\\][\w.~-]*\.[a-z]\w*",  # a relative path to a file
)


class Words:
    """Removes from texts what identifies a machine or a person."""

    def __init__(self, manifest: Mapping[str, Any]) -> None:
        """Collect the names of hosts and users that a manifest has anywhere, and those of this process."""
        names = {socket.gethostname(), *(Path(os.environ.get(name, "")).name for name in ("HOME", "LOGNAME", "USER"))}
        names |= {*map(str, manifest.get("machines") or ())}
        for key, text in _texts(manifest):
            names |= {name for match in _NAMED.findall(text) for name in match}
            names |= {*_NAME.findall(text)} if key == "host" else set()
        plain = _plain()
        names |= {name.partition(".")[0] for name in names}
        names = {name for name in names if len(name) > 1 and _NAME.search(name) and name.lower() not in plain}
        patterns = sorted(map(_pattern, names), key=lambda pattern: (-len(pattern), pattern))
        self._names = re.compile("|".join(patterns) or r"(?!)", re.IGNORECASE)
        self._all = re.compile("|".join((*_PLACES, *patterns)), re.IGNORECASE)
        self._placeholders: dict[str, str] = {}

    def cleaned(self, text: str) -> str:
        for _ in range(_PASSES):
            text = self._all.sub(self._placeholder, text)
        return text

    def _placeholder(self, match: re.Match[str]) -> str:
        return self._placeholders.setdefault(match[0], f"{WITHHELD}-{len(self._placeholders) + 1}")

    def tree(self, value: Any, texts: Collection[str], key: str = "", *, shared: bool = False) -> Any:
        """Return JSON with its numbers and, if ``shared`` or under a key of ``texts``, its texts."""
        if isinstance(value, dict) and key == "packages":  # 5.0.0.93 is no address there
            versions = {self.cleaned(name): str(text) for name, text in value.items() if _VERSION.fullmatch(str(text))}
            return {name: self._names.sub(self._placeholder, text) for name, text in versions.items()}
        if isinstance(value, dict):
            return {
                self.cleaned(name): self.tree(item, texts, name, shared=name in texts or key in MAPS)
                for name, item in value.items()
            }
        if isinstance(value, list):
            return [self.tree(item, texts, key, shared=shared) for item in value]
        if not isinstance(value, str) or not value:
            return value
        if key in HASHED:
            hashed = f"{WITHHELD}, SHA-256 {sha256(value.encode()).hexdigest()[:16]}"
            return value if _HASH.fullmatch(value) else hashed
        return self.cleaned(value) if shared else WITHHELD

    def column(self, name: str, values: Sequence[str | None]) -> list[str]:
        """Return what leaves of a column of a table; an error is a word, as a failed request stays one."""
        if name in COLUMNS:
            cleaned = {value: self.cleaned(value or "") for value in dict.fromkeys(values)}
            return [cleaned[value] for value in values]
        if name == "error":
            return ["failed" if value else "" for value in values]
        return [value if value and name not in HIDDEN and _NUMBER.fullmatch(value) else "" for value in values]


def _pattern(name: str) -> str:
    return re.escape(name) if len(name) >= _LONG else f"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])"


def _plain() -> set[str]:
    transports = [transport for _, transport in TRANSPORTS.loaded()]
    names = {*STAGES, *SPENT, *(name for each in transports for name in (*each.stages, *each.facts))}
    names |= {*TEXTS, *COLUMNS, *TRANSPORTS, *ENGINES, *EXPERIMENTS, *(field.name for field in fields(ExportedRun))}
    return {*_PLAIN.split(), *names, *(word for name in names for word in name.split("_"))}


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield every text of JSON with its key, and every key."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, dict):
        for name, item in value.items():
            yield "", name
            yield from _texts(item, name)
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item, key)


def check_folder(folder: Path) -> None:
    """Raise UsageError for a file, and for a folder with anything that no export wrote."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"`export`: {folder} is a file; name a folder")
    try:
        others = [path for path in sorted(folder.iterdir()) if not _is_export(path)] if folder.exists() else []
    except OSError as error:
        raise UsageError(f"`export`: cannot read {folder}: {error.strerror}; name another folder") from error
    if others:
        raise UsageError(f"`export`: {folder} has {others[0].name}, which no export wrote; name another folder")


def _is_export(folder: Path) -> bool:
    try:
        return KEY in manifests.read(folder)
    except StoreError:
        return False


def write_exports(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Write a folder for each run, and for each finished run of a sweep, and return them; raises StoreError."""
    written: list[Path] = []
    for run in _runs(dict.fromkeys(path.resolve() for path in paths)):
        with fits(run):
            words = Words(run.manifest)
            manifest = _manifest(run.manifest, words)
        when = re.sub(r"[-:]|\+.*", "", manifest["started"]) + "Z" if manifest["started"] else "undated"
        stem = re.sub(r"[^A-Za-z0-9._-]+", "-", f"{when}-{manifest['command']}")
        names = (stem if number == 1 else f"{stem}-{number}" for number in count(1))
        target = next(folder / name for name in names if folder / name not in written)
        if target.resolve() == run.path:
            raise UsageError(f"`export`: {target} is the run itself; name another folder")
        try:
            _write(run, manifest, words, target)
        except OSError as error:
            raise StoreError(f"cannot write {target}: {files.why(error, folder)}") from error
        written.append(target)
    return written


def _runs(paths: Iterable[Path]) -> Iterator[StoredRun]:
    for path in paths:
        run = read_run(path)
        if is_sweep(run.manifest):
            yield from (cell for _, cell in read_sweep(path).runs())
        else:
            yield run


def _manifest(kept: Mapping[str, Any], words: Words) -> dict[str, Any]:
    """Return what leaves of a manifest, in the order of `ExportedRun`; that of a mapping stays, as of stages."""
    of_provenance = {field.name for field in fields(Provenance)}
    whole: dict[str, Any] = {"configuration": {}, "environment": {}, "seeds": {}}
    for name in (field.name for field in fields(ExportedRun) if kept.get(field.name) is not None):
        texts = of_provenance if name == PROVENANCE else TEXTS
        whole[name] = words.tree(kept[name], texts, name, shared=name in TEXTS)
    for name in ("started", "finished"):
        whole[name] = text if _TIME.fullmatch(text := str(kept.get(name))) else None
    codes = [words.cleaned(code) for each in kept.get("warnings", []) if _CODE.fullmatch(code := each["code"])]
    about = {"message": "the text of a warning is not shared", "advice": "see docs/share.md"}
    whole |= {"schema": kept["schema"], "state": kept["state"], "started": whole["started"] or ""}
    whole |= {KEY: {"schema": FORMAT, "files": {}}, "warnings": [{"code": code, **about} for code in codes]}
    return {field.name: whole[field.name] for field in fields(ExportedRun) if field.name in whole}


def _write(run: StoredRun, manifest: dict[str, Any], words: Words, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    manifests.write(target, manifest)  # what is interrupted is an export, too
    for name in tables_in(target):
        (target / name).unlink()
    sources = {name.rpartition(".")[0]: name for name in tables_in(run.path)}  # Parquet, if there are both
    for stem, source in sorted(sources.items()):
        batches = files.read_texts(run.path / source)
        columns = [name for name in next(batches) if name.isidentifier() and words.cleaned(name) == name]
        path = target / f"{stem}.csv"
        if PROVENANCE not in columns or not TABLE.fullmatch(path.name) or words.cleaned(stem) != stem:
            continue  # not a table of a run
        with path.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file:
            file.write(files.record(columns))
            for batch in batches:
                rows = zip(*(words.column(name, batch[name]) for name in columns), strict=True)
                file.writelines(map(files.record, rows))
        manifest[KEY]["files"][path.name] = asdict(ExportedFile.of(path))
    manifests.write(target, manifest)
