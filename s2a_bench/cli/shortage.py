"""What this process may not have enough of, each as one line: open files, address space, threads, room on a disk."""

from __future__ import annotations

import resource
from errno import EAGAIN, EDQUOT, EMFILE, ENFILE, ENOMEM, ENOSPC
from typing import Final

from s2a_bench.errors import S2AError

LEAST_FILES: Final = 64
LEAST_BYTES: Final = 2**30
"""Of address space; with less the numerical libraries end the process as they are loaded."""


def check_limits() -> None:
    """Raise S2AError where the limits of this process leave too little for any command."""
    files, space = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_AS))
    if files != resource.RLIM_INFINITY and files < LEAST_FILES:
        raise S2AError(f"this process may open {files} files, and {LEAST_FILES} are needed; raise `ulimit -n`")
    if space != resource.RLIM_INFINITY and space < LEAST_BYTES:
        raise S2AError(
            f"this process may use {space >> 20} MiB of address space, and {LEAST_BYTES >> 20} are needed; "
            "raise `ulimit -v`"
        )


def shortage(error: Exception) -> str | None:
    """Return what there is too little of, and the way out; None where the error is another one."""
    number = getattr(error, "errno", None)
    text = str(error)
    if number in {EMFILE, ENFILE}:
        return "too many open files; raise `ulimit -n`, or stop what else has files open"
    if number in {ENOSPC, EDQUOT}:
        return f"{text}; make room there, or choose another folder"
    if isinstance(error, MemoryError) or number == ENOMEM or "failed to map segment" in text:
        return "out of memory; stop what else runs, raise `ulimit -v`, or ask for less"
    if number == EAGAIN or "can't start new thread" in text:
        return "no more processes or threads may be started; raise `ulimit -u` or `ulimit -v`"
    return None
