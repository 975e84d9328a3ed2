"""Settings the harness applies to its own processes, all recorded in the manifest."""

from __future__ import annotations

import ctypes
import os

M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
KEEP_BYTES = (1 << 30, 1 << 25)
"""The first that glibc takes: older ones refuse a threshold above 32 MiB.

Blocks up to this size stay with the process. Without it glibc returns every frame's memory to the kernel and each
new frame faults its pages in again, 2.6 us a page (shared/LIMITS.md)."""

SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def keep_large_blocks() -> bool:
    """Tell glibc to keep large freed blocks; returns whether it did (musl has no mallopt)."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    trims = bool(mallopt(M_TRIM_THRESHOLD, KEEP_BYTES[0]))
    return any(mallopt(M_MMAP_THRESHOLD, size) for size in KEEP_BYTES) and trims


def limit_threads() -> None:
    """Keep numeric libraries to one thread each, unless the user decided; llama.cpp has a flag of its own."""
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
