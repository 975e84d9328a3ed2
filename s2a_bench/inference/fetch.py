"""Fetch model files from the hub into its own cache: resumed where they broke off, checked before they count.

The hub library downloads to a file of its own that it deletes when it is interrupted, so gigabytes would start again.
Here its transfer routine appends to a file that stays, named by the SHA-256 that the hub gives for the content. Only
when the content has that hash does it become the blob of the hub's cache; the library then links it where every tool
finds it.
"""

from __future__ import annotations

import fcntl
import io
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from logging import ERROR, getLogger
from pathlib import Path
from typing import Any, TypeAlias

from s2a_bench import extras
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference.fetch_errors import no_hub, one_line
from s2a_bench.inference.fetch_names import HUB_MODELS
from s2a_bench.inference.models import digest, remember_sha256, sha256

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with (file, bytes that are there, bytes in all)."""

_SHA256 = re.compile(r"[0-9a-f]{64}")
_SPARE_BYTES = 100 << 20
"""Left free on the disk, for everything else."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to fetch: a repository of the hub and the names of its files, the language model's first."""

    repository: str
    files: tuple[str, ...]

    @property
    def in_words(self) -> str:
        """Return the files as a person would list them."""
        return f"{' and '.join(self.files)} of {self.repository}"


@dataclass(frozen=True, slots=True)
class HubFile:
    """One file as the hub lists it."""

    name: str
    nbytes: int
    sha256: str


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """A file that is there and has the hub's checksum; ``resumed_at`` bytes of it were there before."""

    path: Path
    nbytes: int
    sha256: str
    resumed_at: int


@dataclass(frozen=True, slots=True)
class Fetched:
    """What `fetch` fetched, from which commit of which hub."""

    endpoint: str
    repository: str
    commit: str
    files: tuple[FetchedFile, ...]


def wanted(what: str, quant: str | None, mmproj: str | None) -> Wanted:
    """Read ``NAME`` or ``ORG/REPO:FILE`` and the flags beside it; raises UsageError where they make no sense."""
    if what in HUB_MODELS:
        known = HUB_MODELS[what]
        return Wanted(known.repository, (known.model_file(quant or known.quant), mmproj or known.mmproj))
    utils = extras.require("huggingface_hub.utils", "model")
    repository, _, file = what.partition(":")
    try:
        utils.validate_repo_id(repository)
    except utils.HFValidationError:
        file = ""
    if not file or "/" not in repository:
        raise UsageError(f"model fetch: '{what}' is neither {', '.join(HUB_MODELS)} nor ORG/REPO:FILE")
    if quant:
        raise UsageError(f"`quant` {quant}: goes with {', '.join(HUB_MODELS)}; with ORG/REPO:FILE, name the file")
    return Wanted(repository, (file, mmproj) if mmproj else (file,))


def fetch(want: Wanted, progress: Progress | None = None) -> Fetched:
    """Fetch the files that are not there yet and check all of them against the hub's SHA-256.

    Raises ModelError, one line, for whatever is in the way: no network, no such file, gated, disk full, wrong content.
    """
    constants = extras.require("huggingface_hub.constants", "model")
    extras.require("huggingface_hub.utils", "model").disable_progress_bars()
    getLogger("huggingface_hub").setLevel(ERROR)  # it tells of each retry with the whole, signed address
    with one_line(want.repository, want.in_words):
        commit, files = _listing(want)
        _check_space(want.repository, files)
        done = tuple(_fetch_file(want.repository, commit, file, progress) for file in files)
    return Fetched(str(constants.ENDPOINT), want.repository, commit, done)


def _listing(want: Wanted) -> tuple[str, tuple[HubFile, ...]]:
    """Ask the hub for its commit and the files' sizes and checksums; a file's case is forgiven."""
    hub = extras.require("huggingface_hub", "model")
    timeout_s = extras.require("huggingface_hub.constants", "model").HF_HUB_ETAG_TIMEOUT
    try:
        info = hub.HfApi().model_info(want.repository, files_metadata=True, timeout=timeout_s)
        siblings = {sibling.rfilename: sibling for sibling in info.siblings or ()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # no JSON, or not a hub's
        raise no_hub(want.repository, want.in_words) from error
    by_case = {name.lower(): name for name in siblings} | {name: name for name in siblings}
    names = (by_case.get(file) or by_case.get(file.lower(), file) for file in want.files)
    return str(info.sha), tuple(_hub_file(want.repository, name, siblings) for name in names)


def _hub_file(repository: str, name: str, siblings: dict[str, Any]) -> HubFile:
    if name not in siblings:
        models = ", ".join(sorted(file for file in siblings if file.endswith(".gguf"))) or "no GGUF file"
        raise ModelError(f"{repository}: has no {name}; it has {models}")
    lfs = siblings[name].lfs
    if lfs is None or not _SHA256.fullmatch(lfs.sha256):
        raise ModelError(f"{repository}: gives no SHA-256 for {name}, so it cannot be checked; download it by hand")
    return HubFile(name, int(lfs.size), lfs.sha256)


def _blob(repository: str, file: HubFile) -> Path:
    """Return where the hub's cache keeps a content (its documented layout)."""
    download = extras.require("huggingface_hub.file_download", "model")
    cache: str = extras.require("huggingface_hub.constants", "model").HF_HUB_CACHE
    folder: str = download.repo_folder_name(repo_id=repository, repo_type="model")
    return Path(cache).expanduser() / folder / "blobs" / file.sha256


def _part(blob: Path) -> Path:
    return blob.with_name(f"{blob.name}.s2a-bench.part")


def _check_space(repository: str, files: tuple[HubFile, ...]) -> None:
    """Refuse before the first byte where the disk cannot hold what is missing."""
    missing = 0
    for file in files:
        blob = _blob(repository, file)
        if not blob.is_file():
            missing += file.nbytes - (_part(blob).stat().st_size if _part(blob).is_file() else 0)
    folder = _blob(repository, files[0]).parent
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    free = shutil.disk_usage(there).free
    if missing > 0 and free < missing + _SPARE_BYTES:
        raise ModelError(
            f"{repository}: {missing / 1e9:.2f} GB are to be fetched and {free / 1e9:.2f} GB are free in {there}; "
            "make room, or set HF_HOME to a folder on another disk"
        )


def _fetch_file(repository: str, commit: str, file: HubFile, progress: Progress | None) -> FetchedFile:
    hub = extras.require("huggingface_hub", "model")
    blob, resumed_at = _blob(repository, file), file.nbytes
    if not blob.is_file():
        blob.parent.mkdir(parents=True, exist_ok=True)
        resumed_at = _download(repository, commit, file, blob, progress)
    if progress is not None:
        progress(file.name, file.nbytes, file.nbytes)
    path = Path(hub.hf_hub_download(repository, file.name))  # finds the blob there and links it
    if sha256(path) != file.sha256:
        raise ModelError(f"{path.resolve()}: does not have the hub's SHA-256 {file.sha256}; delete it and fetch again")
    return FetchedFile(path, file.nbytes, file.sha256, resumed_at)


class _Part(io.BufferedWriter):
    """A file that grows at its end and tells how far it is."""

    def __init__(self, path: Path, tell: Callable[[int], None]) -> None:
        super().__init__(io.FileIO(path, "a"))
        self._tell = tell

    def write(self, data: Any, /) -> int:
        written = super().write(data)
        self._tell(self.tell())
        return written


def _download(repository: str, commit: str, file: HubFile, blob: Path, progress: Progress | None) -> int:
    """Append what is missing, check all of it, and make it the blob; return how much was there before."""
    hub = extras.require("huggingface_hub", "model")
    http_get = extras.require("huggingface_hub.file_download", "model").http_get
    headers = extras.require("huggingface_hub.utils", "model").build_hf_headers()
    part = _part(blob)
    with _Part(part, lambda done: progress(file.name, done, file.nbytes) if progress else None) as content:
        try:
            fcntl.flock(content, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ModelError(f"{file.name}: another process fetches it now ({part}); wait for that one") from None
        if blob.is_file():  # another process has just finished
            return file.nbytes
        if content.tell() > file.nbytes:
            content.seek(0)
            content.truncate()
        there = content.tell()
        # the resolve address, not where it leads: a signed address runs out while a large file is under way
        url = hub.hf_hub_url(repository, file.name, revision=commit)
        http_get(url, content, resume_size=there, headers=headers, expected_size=file.nbytes)
        content.flush()
        found = digest(part)
        if found != file.sha256:
            part.unlink()
            raise ModelError(
                f"{file.name}: has SHA-256 {found}, the hub says {file.sha256}; what arrived was deleted, fetch again"
            )
        part.replace(blob)
    remember_sha256(blob, found)
    return there
