"""Write runs as folders to share (docs/share.md).

Numbers leave. A text leaves if its key or column is on the list, it has the form of words or of a cell's name, and it
has no name of a host or user. Any other text is withheld as a whole.
"""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import StoreError, UsageError
from s2a_bench.inference import ENGINES
from s2a_bench.store import files
from s2a_bench.store import manifest as manifests
from s2a_bench.store.export import FACTS, FORMAT, KEY, TABLE, WITHHELD, ExportedFile, ExportedRun, tables_in
from s2a_bench.store.run import StoredRun, fits, read_run
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.store.sweep import is_sweep, read_sweep
from s2a_bench.trace import STAGES
from s2a_bench.transport import TRANSPORTS

_TEXTS: Final = """
command started finished code s2a_bench kernel machine python cpu governor clock_source board power_mode name driver
ROS_DISTRO ROS_DOMAIN_ID ROS_AUTOMATIC_DISCOVERY_RANGE RMW_IMPLEMENTATION nonce dds unit about what pictures provenance
engine model model_sha256 mmproj_sha256 quantisation architecture projector model_type kv_type flash_attention reader
llama_cpp_python sampling answer latency profile gaps prompt_origin title origin family guarantee asked chosen clock
mode payload size observation policies policy modes rules rule rounding simulator robot robots time transports transport
connection dialect qos dds_tuning middleware template layout llama_server follower gap jitter load limit service link
skills orders outcome env success stall period study start tokens weights link_profile under_way request_id used_by
cell pipeline variant source gap_behaviour phase verdict duration marks facts
"""
TEXTS: Final = frozenset(_TEXTS.split())
"""The keys and columns whose text leaves, alone or in a list."""
HIDDEN: Final = frozenset({"text", "token_id"})
"""Columns that stay empty: what a model wrote, numbers included."""
_INSTEAD: Final = {"error": "failed", "marks": "[]", "facts": "{}"}
"""What stands in a column for a text that does not leave."""

_NUMBER: Final = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?|true|false")
_PROMPT: Final = re.compile(rf"{WITHHELD}, SHA-256 [0-9a-f]{{16}}")
_TEXT: Final = re.compile(
    rf"""\d{{4}}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00                     # a time
    | ([\[\]{{}},:] | "\w*" | (-?\d[\d.e+-]*|null)(?=[],}}]))+       # JSON of identifiers and numbers
    | (?!.*\d(\.\d+){{3}} | .*/\S*\.[a-z] | .*\b(home|users)/        # words without an address, a file in a folder,
      | .*(?<![\w-])(?!({"|".join(sorted(TEXTS))})=)[\w-]+=(?!-?\d)) # an option off the list
      ([\w .,;()=?&+*%'`#|<>°-] | :(?=\s|$) | (?<=[ ])@(?=[ ]) | (?<=[^\W_])/(?=[^\W_]))+""",
    re.IGNORECASE | re.VERBOSE,
)
_FORMS: Final = {
    "packages": re.compile(rf"\d+(\.\d+){{1,3}}([.+-]?[A-Za-z]\w*)*|{WITHHELD}-\d+"),
    **dict.fromkeys(("stages", "service", "variants"), _TEXT),
}
"""The form of every text in mappings of these keys."""
_PLACES: Final = re.compile(
    r'"host": "([\w.-]+)|[/\\](?:home|users)[/\\]+([\w.-]+)|://(?:[^/@"]*@)?([\w.-]+)', re.IGNORECASE
)
"""Where a manifest has the names of hosts and users."""
_PLAIN: Final = "localhost none real root home jetson nvidia ubuntu cpu gpu memory power energy client"
"""Names of hosts and users that identify nothing, as the list, stages, transports and engines."""


class Filter:
    """Selects the texts of a run that leave; one that does not has the same placeholder everywhere."""

    def __init__(self, manifest: Mapping[str, Any]) -> None:
        """Collect the names of hosts and users that a manifest has, and those of this process."""
        names = {socket.gethostname(), *(Path(os.environ.get(name, "")).name for name in ("HOME", "LOGNAME", "USER"))}
        names |= {name for match in _PLACES.findall(json.dumps(manifest, ensure_ascii=False)) for name in match}
        names = {part.lower() for name in names for part in (name, name.partition(".")[0])}
        plain = re.findall(r"[a-z\d]+", " ".join((_PLAIN, WITHHELD, *TEXTS, *STAGES, *TRANSPORTS, *ENGINES)).lower())
        names = {name for name in names if re.search("[a-z].|.[a-z]", name)}.difference(plain)
        every = "|".join(map(re.escape, sorted(names, reverse=True))) or r"(?!)"
        self._names = re.compile(rf"(?<![^\W_])({every})(?![^\W_])", re.IGNORECASE)
        self._placeholders: dict[str, str] = {}

    def text(self, text: str, form: re.Pattern[str] = _TEXT, instead: str = "") -> str:
        """Return a text that leaves; else what is written instead, by default its placeholder."""
        if not text or (form.fullmatch(text) and not self._names.search(text)):
            return text
        return instead or self._placeholders.setdefault(text, f"{WITHHELD}-{len(self._placeholders) + 1}")

    def tree(self, value: Any, key: str, form: re.Pattern[str] | None = None) -> Any:
        """Return JSON with its numbers, and with texts whose key is on the list or that have a form."""
        form = _TEXT if key in TEXTS else form
        if isinstance(value, dict):
            return {self.text(name): self.tree(item, name, _FORMS.get(key)) for name, item in value.items()}
        if isinstance(value, list):
            return [self.tree(item, key, form) for item in value]
        if not isinstance(value, str) or not value or (key == "prompt" and _PROMPT.fullmatch(value)):
            return value
        if key == "prompt":
            return f"{WITHHELD}, SHA-256 {sha256(value.encode()).hexdigest()[:16]}"
        return self.text(value, form) if form else WITHHELD

    def column(self, name: str, values: list[str | None]) -> list[str]:
        """Return what leaves of a column; an error is a word, as a failed request stays one."""
        instead = _INSTEAD.get(name, "")
        if name in HIDDEN:
            return [""] * len(values)
        if name not in TEXTS:
            return ["" if not value else value if _NUMBER.fullmatch(value) else instead for value in values]
        texts = {value: self.text(value or "", instead=instead) for value in dict.fromkeys(values)}
        return [texts[value] for value in values]


def check_folder(folder: Path) -> None:
    """Raise UsageError for a file, and for a folder with anything that no export wrote."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"`export`: {folder} is a file; name a folder")
    for path in sorted(folder.glob("*")):
        with suppress(StoreError):
            if KEY in manifests.read(path):
                continue
        raise UsageError(f"`export`: {folder} has {path.name}, which no export wrote; name another folder")


def write_exports(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Write a folder for each run, and for each finished run of a sweep, and return them; raises StoreError."""
    written: list[Path] = []
    for run in _runs(dict.fromkeys(path.resolve() for path in paths)):
        with fits(run):
            share = Filter(run.manifest)
            manifest = _manifest(run.manifest, share)
        when = re.sub(r"[-:]|\+.*", "", manifest["started"]) + "Z" if manifest["started"] else "undated"
        stem = re.sub(r"[^A-Za-z0-9._-]+", "-", f"{when}-{manifest['command']}")
        names = (stem if number == 1 else f"{stem}-{number}" for number in count(1))
        target = next(folder / name for name in names if folder / name not in written)
        if target.resolve() == run.path:
            raise UsageError(f"`export`: {target} is the run itself; name another folder")
        try:
            _write(run, manifest, share, target)
        except OSError as error:
            raise StoreError(f"cannot write {target}: {files.why(error, folder)}") from error
        written.append(target)
    return written


def _runs(paths: Iterable[Path]) -> Iterator[StoredRun]:
    for path in paths:
        run = read_run(path)
        yield from (cell for _, cell in read_sweep(path).runs()) if is_sweep(run.manifest) else (run,)


def _manifest(kept: Mapping[str, Any], share: Filter) -> dict[str, Any]:
    """Return what leaves of a manifest."""
    kept = {"started": "", "configuration": {}, "environment": {}, "seeds": {}, "warnings": [], **kept}
    whole = {"schema": kept["schema"], "state": kept["state"], KEY: {"schema": FORMAT, "files": {}}}
    names = {*(field.name for field in fields(ExportedRun)), *FACTS}.difference(whole)
    return whole | {name: share.tree(item, name) for name, item in kept.items() if name in names and item is not None}


def _write(run: StoredRun, manifest: dict[str, Any], share: Filter, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    manifests.write(target, manifest)  # what is interrupted is an export, too
    for name in tables_in(target):
        (target / name).unlink()
    sources = {name.rpartition(".")[0]: name for name in tables_in(run.path)}  # Parquet, if there are both
    for stem, source in sorted(sources.items()):
        table = files.read_texts(run.path / source)
        columns = [name for name in table.column_names if name.isidentifier() and share.text(name) == name]
        path = target / f"{stem}.csv"
        if PROVENANCE not in columns or not TABLE.fullmatch(path.name) or share.text(stem) != stem:
            continue  # not a table of a run
        with path.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file:
            file.write(files.record(columns))
            for batch in table.select(columns).to_batches(max_chunksize=1 << 16):
                rows = zip(*map(share.column, columns, batch.to_pydict().values()), strict=True)
                file.writelines(map(files.record, rows))
        manifest[KEY]["files"][path.name] = asdict(ExportedFile.of(path))
    manifests.write(target, manifest)
