"""Fetch model files from the hub into the hub library's cache: resumed after an interruption, and checked.

The hub library downloads to a temporary file that it deletes when it is interrupted, so gigabytes would start again.
Here its transfer routine appends to a file that stays, named by the SHA-256 that the hub lists for the content. Content
with that hash becomes the blob of the hub's cache; the library then links it where every tool finds it.
"""

from __future__ import annotations

import errno
import fcntl
import io
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from logging import ERROR, getLogger
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from s2a_bench import extras
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference.models import digest, hub_address, pair, remember_sha256, sha256
from s2a_bench.store.schema import Count, Facts, about

Progress: TypeAlias = Callable[[str, int, int], None]
"""(file, bytes present, total bytes) -> None."""

QUANTS = "Q4_K_M", "Q8_0"
"""The default quantisations of a language model, in this order."""

_SHA256 = re.compile(r"[0-9a-f]{64}")
Sha256 = Annotated[str, Facts(pattern="^[0-9a-f]{64}$")]
_SPARE_BYTES = 100 << 20
"""Left free on the disk."""
_REFUSED = (401, 403, 404)
"""A hub's status codes for a wrong name, and for a wrong or missing token."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to fetch of a repository: a file, or else the language model of a quantisation and its mmproj."""

    repository: str
    file: str = ""
    quant: str | None = None
    mmproj: str | None = None

    def files(self, listed: Iterable[str]) -> tuple[str, ...]:
        """Choose from the repository's file names, the language model's first; raises ModelError if none fits."""
        if self.file:
            return (self.file, self.mmproj) if self.mmproj else (self.file,)
        ggufs = [Path(name) for name in listed if name.endswith(".gguf")]
        models, mmproj = pair(ggufs, *((self.quant,) if self.quant else QUANTS))
        if len(models) != 1 or (self.quant and self.quant.lower() not in models[0].name.lower()):
            names = ", ".join(path.as_posix() for path in sorted(ggufs)) or "no GGUF file"
            quants = self.quant or " or ".join(QUANTS)
            raise ModelError(
                f"{self.repository}: no model is {quants}, or several; it has {names}; name one as OWNER/REPO:FILE"
            )
        tower = self.mmproj or (mmproj.as_posix() if mmproj else "")
        return (models[0].as_posix(), tower) if tower else (models[0].as_posix(),)


@dataclass(frozen=True, slots=True)
class HubFile:
    """One file as the hub lists it, and the path of its content in the hub's cache (a documented layout)."""

    name: str
    nbytes: int
    sha256: str
    blob: Path

    @property
    def part(self) -> Path:
        return self.blob.with_name(f"{self.blob.name}.s2a-bench.part")


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """One fetched file."""

    path: Path
    bytes: Count
    sha256: Sha256
    resumed_at: Annotated[Count, about("Bytes that were there before; all of them where nothing was downloaded.")]


@dataclass(frozen=True, slots=True)
class Fetched:
    endpoint: str
    repository: str
    commit: str
    files: tuple[FetchedFile, ...]


def wanted(what: str, quant: str | None, mmproj: str | None) -> Wanted:
    """Read ``NAME`` or ``OWNER/REPO[:FILE]`` and its flags; raises UsageError if they make no sense."""
    repository, file = hub_address(what, "model fetch:")
    if file and quant:
        raise UsageError(f"`quant` {quant}: goes with a name or OWNER/REPO; with OWNER/REPO:FILE, name the file")
    return Wanted(repository, file, quant, mmproj)


def fetch(want: Wanted, progress: Progress | None = None) -> Fetched:
    """Fetch the missing files and check all of them against the hub's SHA-256.

    Raises ModelError, one line, if that fails: no network, no such file, gated, disk full, wrong content.
    """
    extras.require("huggingface_hub.utils", "model").disable_progress_bars()
    getLogger("huggingface_hub").setLevel(ERROR)  # it logs each retry with the whole, signed address
    with _one_line(want):
        commit, files = _listing(want)
        _check_space(want.repository, files)
        # the language model last: what is interrupted before is not taken for a text model
        done = [_fetch_file(want.repository, commit, file, progress) for file in reversed(files)]
    return Fetched(_endpoint(), want.repository, commit, tuple(reversed(done)))


def _endpoint() -> str:
    return str(extras.require("huggingface_hub.constants", "model").ENDPOINT)


def _listing(want: Wanted) -> tuple[str, tuple[HubFile, ...]]:
    """Return the hub's commit and the files' sizes and checksums; file names match in any case."""
    hub = extras.require("huggingface_hub", "model")
    timeout_s = extras.require("huggingface_hub.constants", "model").HF_HUB_ETAG_TIMEOUT
    try:
        info = hub.HfApi().model_info(want.repository, files_metadata=True, timeout=timeout_s)
        siblings = {sibling.rfilename: sibling for sibling in info.siblings or ()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # no JSON, or not a hub's
        raise ModelError(f"{want.repository}: {_no_hub(want)}") from error
    by_case = {name.lower(): name for name in siblings} | {name: name for name in siblings}
    names = (by_case.get(file) or by_case.get(file.lower(), file) for file in want.files(siblings))
    return str(info.sha), tuple(_hub_file(want.repository, name, siblings) for name in names)


def _hub_file(repository: str, name: str, siblings: dict[str, Any]) -> HubFile:
    if name not in siblings:
        models = ", ".join(sorted(file for file in siblings if file.endswith(".gguf"))) or "no GGUF file"
        raise ModelError(f"{repository}: has no {name}; it has {models}")
    lfs = siblings[name].lfs
    if lfs is None or not _SHA256.fullmatch(lfs.sha256):
        raise ModelError(f"{repository}: gives no SHA-256 for {name}, so it cannot be checked; download it by hand")
    download = extras.require("huggingface_hub.file_download", "model")
    cache: str = extras.require("huggingface_hub.constants", "model").HF_HUB_CACHE
    folder: str = download.repo_folder_name(repo_id=repository, repo_type="model")
    return HubFile(name, int(lfs.size), lfs.sha256, Path(cache).expanduser() / folder / "blobs" / lfs.sha256)


def _check_space(repository: str, files: tuple[HubFile, ...]) -> None:
    """Raise ModelError before the first byte if the disk cannot hold the missing ones."""
    absent = [file for file in files if not file.blob.is_file()]
    missing = sum(file.nbytes - (file.part.stat().st_size if file.part.is_file() else 0) for file in absent)
    folder = files[0].blob.parent
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    free = shutil.disk_usage(there).free
    if missing > 0 and free < missing + _SPARE_BYTES:
        raise ModelError(
            f"{repository}: {missing / 1e9:.2f} GB are to be fetched and {free / 1e9:.2f} GB are free in {there}; "
            "make room, or set HF_HOME to a folder on another disk"
        )


def _fetch_file(repository: str, commit: str, file: HubFile, progress: Progress | None) -> FetchedFile:
    hub = extras.require("huggingface_hub", "model")
    resumed_at = file.nbytes
    if not file.blob.is_file():
        file.blob.parent.mkdir(parents=True, exist_ok=True)
        resumed_at = _download(repository, commit, file, progress)
    if progress is not None:
        progress(file.name, file.nbytes, file.nbytes)
    path = Path(hub.hf_hub_download(repository, file.name))  # finds the blob there and links it
    if sha256(path) != file.sha256:
        raise ModelError(f"{path.resolve()}: does not have the hub's SHA-256 {file.sha256}; delete it and fetch again")
    return FetchedFile(path, file.nbytes, file.sha256, resumed_at)


class _Part(io.BufferedWriter):
    def __init__(self, path: Path, report: Callable[[int], None]) -> None:
        super().__init__(io.FileIO(path, "a"))
        self._report = report

    def write(self, data: Any, /) -> int:
        written = super().write(data)
        self._report(self.tell())
        return written


def _download(repository: str, commit: str, file: HubFile, progress: Progress | None) -> int:
    """Append the missing bytes, check the file, and make it the blob; return the size before."""
    hub = extras.require("huggingface_hub", "model")
    http_get = extras.require("huggingface_hub.file_download", "model").http_get
    headers = extras.require("huggingface_hub.utils", "model").build_hf_headers()
    with _Part(file.part, lambda done: progress(file.name, done, file.nbytes) if progress else None) as content:
        try:
            fcntl.flock(content, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ModelError(f"{file.name}: another process fetches it now ({file.part}); wait for that one") from None
        if file.blob.is_file():  # another process has just finished
            return file.nbytes
        if content.tell() > file.nbytes:
            content.seek(0)
            content.truncate()
        size_before = content.tell()
        # the resolve address, without its redirection: a signed address expires during a long download
        url = hub.hf_hub_url(repository, file.name, revision=commit)
        http_get(url, content, resume_size=size_before, headers=headers, expected_size=file.nbytes)
        content.flush()
        found = digest(file.part)
        if found != file.sha256:
            file.part.unlink()
            raise ModelError(
                f"{file.name}: has SHA-256 {found}, the hub says {file.sha256}; what arrived was deleted, fetch again"
            )
        file.part.replace(file.blob)
    remember_sha256(file.blob, found)
    return size_before


def _by_hand(want: Wanted) -> str:
    files = " and ".join(filter(None, (want.file or "the language model", want.mmproj or "its mmproj")))
    return f"download {files} of {want.repository} by hand and give --model PATH --mmproj PATH"


def _no_hub(want: Wanted) -> str:
    return f"{_endpoint()} does not answer as a hub does; check HF_ENDPOINT and your proxy, or {_by_hand(want)}"


def _status(error: Any, want: Wanted) -> str:
    status = int(error.response.status_code)
    message = f": {error.server_message}" if error.server_message else ""
    way_out = "check the name, or set HF_TOKEN" if status in _REFUSED else f"try again later, or {_by_hand(want)}"
    return f"{_endpoint()} answered {status}{message}; {way_out}"


def _unreachable(error: Any, want: Wanted) -> str:
    if getattr(error, "errno", None) == errno.ENOSPC:
        return "the disk is full; make room, or set HF_HOME to a folder on another disk, and fetch again"
    if getattr(error, "filename", None):
        return f"cannot write {error.filename} ({error.strerror}); set HF_HOME to a folder you may write"
    return (
        f"cannot be fetched from {_endpoint()} ({type(error).__name__}: {error}); what has arrived is "
        f"kept, so try again, set HF_ENDPOINT to a hub in reach, or {_by_hand(want)}"
    )


@contextmanager
def _one_line(want: Wanted) -> Iterator[None]:
    errors = extras.require("huggingface_hub.errors", "model")
    # the hub library has changed its HTTP client twice: the client's base error is found through the library
    client_error: Any = errors.HfHubHTTPError.__mro__[1]
    try:
        yield
    except Exception as error:
        match error:
            case errors.OfflineModeIsEnabled():
                reason = f"HF_HUB_OFFLINE is set, so nothing is fetched; unset it, or {_by_hand(want)}"
            case errors.GatedRepoError():
                reason = f"gated; ask for access on its page at {_endpoint()}, then set HF_TOKEN and fetch again"
            case errors.RepositoryNotFoundError():
                reason = f"no such repository at {_endpoint()}, or a private one; check the name, or set HF_TOKEN"
            case errors.FileMetadataError():
                reason = _no_hub(want)
            case errors.LocalEntryNotFoundError():
                reason = _unreachable(error, want)
            case errors.HfHubHTTPError():
                reason = _status(error, want)
            case client_error() | OSError() | ValueError():
                reason = _unreachable(error, want)
            case _:
                raise
        raise ModelError(" ".join(f"{want.repository}: {reason}".split())) from error
