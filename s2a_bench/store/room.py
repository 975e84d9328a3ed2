"""Room on a file system: what is said where there is none, and a little kept for saying it."""

from __future__ import annotations

import os
import shutil
from errno import EDQUOT, ENOSPC
from pathlib import Path
from typing import Final

RESERVE: Final = ".reserve"
RESERVE_BYTES: Final = 256 * 1024
"""Kept in a run folder while it is written, so that a run that fills its disk can still say so in its manifest."""


def why(error: OSError, path: Path) -> str:
    """Return why a path could not be written; where there was no room, on which file system."""
    said = error.strerror or str(error)
    if error.errno not in {ENOSPC, EDQUOT}:
        return said
    mount = next(place for place in (path.resolve(), *path.resolve().parents) if os.path.ismount(place))
    try:
        free = f", {shutil.disk_usage(mount).free:,} bytes free"
    except OSError:
        free = ""
    return f"{said} (file system {mount}{free}; make room, or choose another `output`)"


def reserve(folder: Path) -> None:
    """Keep room in a folder; on a file system that has none the run ends here, before anything is measured."""
    with (folder / RESERVE).open("wb") as file:
        file.write(bytes(RESERVE_BYTES))  # not only allocated: some file systems promise more than they have


def release(folder: Path) -> bool:
    """Give the room back; return whether there was any."""
    try:
        (folder / RESERVE).unlink()
    except FileNotFoundError:
        return False
    return True
