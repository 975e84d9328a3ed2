"""Settings the harness applies to its own processes, all recorded in the manifest."""

from __future__ import annotations

import ctypes
import os

M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
KEEP_BYTES = 1 << 30
"""Blocks up to this size stay with the process. Without it glibc returns every frame's memory to the kernel and each
new frame faults its pages in again, 2.6 us a page (shared/LIMITS.md)."""

SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def keep_large_blocks() -> bool:
    """Tell glibc to keep large freed blocks; returns whether it did (musl has no mallopt)."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    # mallopt takes ints: half of 2 GiB is the largest power of two that fits
    return bool(mallopt(M_MMAP_THRESHOLD, KEEP_BYTES)) and bool(mallopt(M_TRIM_THRESHOLD, KEEP_BYTES))


def limit_threads() -> None:
    """Keep numeric libraries to one thread each, unless the user decided; llama.cpp has a flag of its own."""
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
