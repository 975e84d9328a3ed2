"""Fetch model files with the hub's library into its cache, and check their SHA-256."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass
from logging import ERROR, getLogger
from pathlib import Path
from typing import Annotated, Any

from s2a_bench import extras
from s2a_bench.bounds import Count, Facts
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference import FetchConfig
from s2a_bench.inference.models import hub_address, pair, sha256

QUANTS = "Q4_K_M", "Q8_0"
"""The default quantisations of a language model, in this order."""


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """One fetched file."""

    path: Path
    bytes: Count
    sha256: Annotated[str, Facts(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True, slots=True)
class Fetched:
    endpoint: str
    repository: str
    commit: str
    files: tuple[FetchedFile, ...]
    """The language model's first."""


def fetch(config: FetchConfig) -> Fetched:
    """Fetch the missing files of a model, and check all of them against the SHA-256 that the hub lists.

    Raises UsageError for a wrong name, and ModelError, one line: no network, gated, no such file, wrong content.
    """
    repository, file = hub_address(config.what, "model fetch:")
    if file and config.quant:
        raise UsageError(f"`quant` {config.quant}: goes with a name or OWNER/REPO; with OWNER/REPO:FILE, name the file")
    api = extras.require("huggingface_hub", "model").HfApi()
    timeout_s = extras.require("huggingface_hub.constants", "model").HF_HUB_ETAG_TIMEOUT
    getLogger("huggingface_hub").setLevel(ERROR)  # it logs each retry with the whole, signed address
    info = _call(api.model_info, repository, files_metadata=True, timeout=timeout_s)
    lfs = {sibling.rfilename: sibling.lfs for sibling in info.siblings or ()}
    names = selected_files(repository, file, config, lfs)
    if unchecked := [name for name in names if not lfs[name]]:
        raise ModelError(
            f"{repository}: gives no SHA-256 for {unchecked[0]}, so it cannot be checked; fetch it by hand"
        )
    files: list[FetchedFile] = []
    for name in reversed(names):  # a language model that is there without its mmproj would pass for a text model
        path = Path(_call(api.hf_hub_download, repository, filename=name, revision=info.sha))
        if (digest := sha256(path)) != lfs[name].sha256:
            for each in {path, path.resolve()}:  # the cache's link, and the file that it leads to
                each.unlink()
            raise ModelError(
                f"{name}: has SHA-256 {digest}, the hub says {lfs[name].sha256}; it was deleted, fetch again"
            )
        files.insert(0, FetchedFile(path, path.stat().st_size, digest))
    return Fetched(api.endpoint, repository, info.sha, tuple(files))


def selected_files(repository: str, file: str, config: FetchConfig, listed: Collection[str]) -> list[str]:
    """Return the names of the language model, ``file`` if given, and of the mmproj, if there is one.

    They are of the repository's names ``listed``, in upper or lower case. Raises ModelError if none fits, or several.
    """
    ggufs = sorted(Path(name) for name in listed if name.endswith(".gguf"))
    there = ", ".join(map(str, ggufs)) or "no GGUF file"
    models, mmproj = pair(ggufs, [config.quant] if config.quant else QUANTS)
    wanted = [file, config.mmproj or ""]
    if not file:
        if len(models) != 1 or (config.quant or "").lower() not in models[0].name.lower():
            quants = config.quant or " or ".join(QUANTS)
            raise ModelError(
                f"{repository}: no model is {quants}, or several; it has {there}; name one as OWNER/REPO:FILE"
            )
        wanted = [str(models[0]), config.mmproj or str(mmproj or "")]
    by_lower = {name.lower(): name for name in listed} | {name: name for name in listed}
    names = {name: by_lower.get(name, by_lower.get(name.lower(), "")) for name in wanted if name}
    if missing := [name for name, listed_as in names.items() if not listed_as]:
        raise ModelError(f"{repository}: has no {missing[0]}; it has {there}")
    return [*names.values()]


def _call(function: Callable[..., Any], repository: str, **arguments: Any) -> Any:
    """Call the hub's library; whatever it raises becomes a ModelError of one line."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "Not enough free disk space")
            return function(repository, **arguments)
    except Exception as error:
        raise ModelError(" ".join(f"{repository}: {_reason(error)}".split())) from error


def _reason(error: BaseException) -> str:
    errors = extras.require("huggingface_hub.errors", "model")
    endpoint = extras.require("huggingface_hub.constants", "model").ENDPOINT
    by_hand = "download its files by hand and give --model PATH --mmproj PATH"
    if isinstance(error, errors.LocalEntryNotFoundError):  # a request failed; the cause says why
        error = error.__cause__ or error
    match error:
        case errors.GatedRepoError():
            return f"gated; ask for access on its page at {endpoint}, then set HF_TOKEN and fetch again"
        case errors.RepositoryNotFoundError():
            return f"no such repository at {endpoint}, or a private one; check the name, or set HF_TOKEN"
        case errors.HfHubHTTPError():
            answer = f"{error.response.status_code} {error.server_message or ''}".rstrip(" .")
            return f"{endpoint} answered {answer}; check the name and HF_TOKEN, try later, or {by_hand}"
    if getattr(error, "filename", None) or re.search("disk space|No space left|quota exceeded", str(error)):
        return f"cannot be written ({error}); make room, or set HF_HOME to a folder that you may write"
    way_out = f"check the network, set HF_ENDPOINT to a hub in reach, or {by_hand}"
    return f"cannot be fetched from {endpoint} ({type(error).__name__}: {error}); {way_out}"
