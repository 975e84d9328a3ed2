"""What can go wrong at the hub, as one line each that names the way out."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import ModelError

_REFUSED = (401, 403, 404)
"""What a hub answers to a wrong name, a wrong token, or none."""


def _endpoint() -> str:
    return str(extras.require("huggingface_hub.constants", "model").ENDPOINT)


def _offline(repository: str, by_hand: str, _error: Any) -> str:
    return f"{repository}: HF_HUB_OFFLINE is set, so nothing is fetched; unset it, or {by_hand}"


def _gated(repository: str, _by_hand: str, _error: Any) -> str:
    return f"{repository}: gated; ask for access on its page at {_endpoint()}, then set HF_TOKEN and fetch again"


def _no_repository(repository: str, _by_hand: str, _error: Any) -> str:
    return f"{repository}: no such repository at {_endpoint()}, or a private one; check the name, or set HF_TOKEN"


def _status(repository: str, by_hand: str, error: Any) -> str:
    status = int(error.response.status_code)
    said = f": {error.server_message}" if error.server_message else ""
    way_out = "check the name, or set HF_TOKEN" if status in _REFUSED else f"try again later, or {by_hand}"
    return f"{repository}: {_endpoint()} answered {status}{said}; {way_out}"


def _unreachable(repository: str, by_hand: str, error: Any) -> str:
    if getattr(error, "errno", None) == errno.ENOSPC:
        return f"{repository}: the disk is full; make room, or set HF_HOME to a folder on another disk, and fetch again"
    if getattr(error, "filename", None):
        return f"{repository}: cannot write {error.filename} ({error.strerror}); set HF_HOME to a folder you may write"
    return (
        f"{repository}: cannot be fetched from {_endpoint()} ({type(error).__name__}: {error}); what has arrived is "
        f"kept, so try again, set HF_ENDPOINT to a hub in reach, or {by_hand}"
    )


def _no_hub(repository: str, by_hand: str, _error: Any) -> str:
    return f"{repository}: {_endpoint()} does not answer as a hub does; check HF_ENDPOINT and your proxy, or {by_hand}"


def no_hub(repository: str, files: str) -> ModelError:
    """Say that what answers is no hub."""
    return ModelError(_no_hub(repository, _by_hand(files), None))


def _by_hand(files: str) -> str:
    return f"download {files} by hand and give --model PATH --mmproj PATH"


@contextmanager
def one_line(repository: str, files: str) -> Iterator[None]:
    """Turn what the hub library raises into a ModelError of one line; ``files`` are those to fetch by hand."""
    errors = extras.require("huggingface_hub.errors", "model")
    # the hub library has changed its HTTP client twice, so the client's base error cannot be named by import
    client_error: Any = errors.HfHubHTTPError.__mro__[1]
    table: tuple[tuple[Any, Callable[[str, str, Any], str]], ...] = (
        (errors.OfflineModeIsEnabled, _offline),
        (errors.GatedRepoError, _gated),
        (errors.RepositoryNotFoundError, _no_repository),
        (errors.FileMetadataError, _no_hub),
        (errors.LocalEntryNotFoundError, _unreachable),
        (errors.HfHubHTTPError, _status),
        ((client_error, OSError, ValueError), _unreachable),
    )
    try:
        yield
    except Exception as error:
        for kinds, say in table:
            if isinstance(error, kinds):
                raise ModelError(" ".join(say(repository, _by_hand(files), error).split())) from error
        raise
