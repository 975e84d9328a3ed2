"""Processes of the harness: settings by which they measure more evenly, and children that never outlive their parent.

Settings are recorded in the manifest. The command line, the servers and the library allow them, each as long as it
measures; then they are what they were before. Where they are not allowed nothing is changed.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from threading import Thread, current_thread, main_thread
from typing import Any, Final

PR_SET_PDEATHSIG: Final = 1
_prctl = ctypes.CDLL(None).prctl
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
M_ARENA_MAX = -8
KEEP_BYTES = 1 << 25
"""Blocks up to this size, the most that glibc takes everywhere, stay with the process: a frame of 3840x2160 in RGB is
smaller. Without it glibc returns every frame's memory to the kernel and each new frame faults its pages in again,
2.6 us a page. What is larger, as a request at its limit, goes back at once."""

KEEP_FREE_BYTES = 1 << 30
"""So much may lie free at the end of the heap."""

SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


_undo: ExitStack | None = None
"""Where this process may be tuned: what puts its settings back."""


@contextmanager
def allowed(yes: bool = True) -> Iterator[None]:
    """Allow this process to be tuned inside the block; after it the settings are those from before.

    What glibc cannot take back: its thresholds are no longer its own to move, and new threads may share one arena.
    """
    global _undo  # noqa: PLW0603 - settings of a process are global
    if _undo is not None or not yes:
        yield
        return
    with ExitStack() as undo:
        _undo = undo
        try:
            yield
        finally:
            _undo = None


def is_allowed() -> bool:
    """Whether this process may be tuned."""
    return _undo is not None


def keep_large_blocks() -> bool:
    """Tell glibc to keep large freed blocks; returns whether it did (not allowed, or musl, which has no mallopt).

    All threads share them: an arena each would keep the most that each thread ever held.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if _undo is None or mallopt is None:
        return False
    _undo.callback(give_back_memory)
    _undo.callback(mallopt, M_TRIM_THRESHOLD, 2 * KEEP_BYTES)  # what glibc comes to by itself with blocks of that size
    _undo.callback(mallopt, M_ARENA_MAX, 0)
    mallopt(M_ARENA_MAX, 1)
    return all(mallopt(*told) for told in ((M_TRIM_THRESHOLD, KEEP_FREE_BYTES), (M_MMAP_THRESHOLD, KEEP_BYTES)))


def give_back_memory() -> None:
    """Free what lies in cycles, and give what lies free to the kernel: a block that grew in place stays in the heap."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # musl has none
        trim(0)


def limit_threads() -> None:
    """Keep OpenCV and numeric libraries to one thread each, unless the user decided; llama.cpp has a flag of its own.

    One conversion of a picture takes a fraction of a millisecond: OpenCV's worker threads save little of it and compete
    with the model and the middleware for cores, which would disturb what is measured.
    """
    if _undo is None:
        return
    for name in set(SINGLE_THREADED) - set(os.environ):
        os.environ[name] = "1"
        _undo.callback(os.environ.pop, name, None)
    import cv2

    _undo.callback(cv2.setNumThreads, cv2.getNumThreads())
    cv2.setNumThreads(1)


def end_with_parent(number: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel end this process when the thread that started it is gone, however it went."""
    _prctl(PR_SET_PDEATHSIG, number)


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a program that the kernel kills, stopped or not, when this process is gone; options are those of `Popen`.

    The kernel acts when the *thread* that started the program ends. Away from the main thread a thread of its own
    starts it therefore, and stays until the program has ended.
    """
    parent = os.getpid()

    def tie() -> None:
        end_with_parent()
        if os.getppid() != parent:  # it ended before the kernel was told
            os.kill(os.getpid(), signal.SIGKILL)

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, preexec_fn=tie, **options)  # noqa: PLW1509, S603 - two calls into C; ours

    if current_thread() is main_thread():
        return start()
    started: Future[subprocess.Popen[bytes]] = Future()

    def start_and_stay() -> None:
        try:
            child = start()
        except BaseException as error:  # noqa: BLE001 - it is the caller's
            started.set_exception(error)
            return
        started.set_result(child)
        with suppress(ChildProcessError):  # whoever has the child has seen it end
            os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)

    Thread(target=start_and_stay, name="starter", daemon=True).start()
    return started.result()
