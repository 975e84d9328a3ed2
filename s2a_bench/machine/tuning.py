"""Processes of the harness: settings for steadier measurements, and children that never outlive their parent.

The settings are recorded in the manifest. The command line, the servers and the library allow them while they measure;
afterwards the old settings are restored. Nothing is changed unless it is allowed.
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
_libc = ctypes.CDLL(None)
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
M_ARENA_MAX = -8
KEEP_BYTES = 1 << 25
"""Freed blocks up to this size, glibc's upper limit, stay in the process: a frame of 3840x2160 in RGB is smaller.
Otherwise glibc returns every frame's memory to the kernel and each new frame faults its pages in again, 2.6 us a page.
A larger block, as a request at its limit, is returned at once."""

KEEP_FREE_BYTES = 1 << 30
"""Free bytes that may stay at the end of the heap."""

SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_undo: ExitStack | None = None
"""Restores the settings; None if this process may not be tuned."""


@contextmanager
def allowed(yes: bool = True) -> Iterator[None]:
    """Allow this process to be tuned inside the block; the old settings are restored after it.

    glibc cannot restore two things: it no longer adapts its thresholds, and new threads may share one arena.
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
    return _undo is not None


def keep_large_blocks() -> bool:
    """Make glibc keep large freed blocks; return False if that is not allowed.

    All threads share one arena: several would each keep the most that their threads ever held.
    """
    mallopt = _libc.mallopt
    if _undo is None:
        return False
    _undo.callback(give_back_memory)
    _undo.callback(mallopt, M_TRIM_THRESHOLD, 2 * KEEP_BYTES)  # the value that glibc adapts to with such blocks
    _undo.callback(mallopt, M_ARENA_MAX, 0)
    mallopt(M_ARENA_MAX, 1)
    return all(mallopt(*pair) for pair in ((M_TRIM_THRESHOLD, KEEP_FREE_BYTES), (M_MMAP_THRESHOLD, KEEP_BYTES)))


def give_back_memory() -> None:
    """Collect cycles, and return free memory to the kernel: a block that grew in place stays in the heap."""
    gc.collect()
    _libc.malloc_trim(0)


def limit_threads() -> None:
    """Limit OpenCV and numeric libraries to one thread each, unless the user set it: more would compete for cores."""
    if _undo is None:
        return
    for name in set(SINGLE_THREADED) - set(os.environ):
        os.environ[name] = "1"
        _undo.callback(os.environ.pop, name, None)
    import cv2

    _undo.callback(cv2.setNumThreads, cv2.getNumThreads())
    cv2.setNumThreads(1)


def end_with_parent(number: signal.Signals = signal.SIGKILL) -> None:
    """Make the kernel end this process when the thread that started it ends."""
    _libc.prctl(PR_SET_PDEATHSIG, number)


def obey_parent() -> None:
    """Prepare a worker process: Ctrl-C is its parent's to handle, which it does not outlive."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a program that the kernel kills, stopped or not, when this process ends; options are those of `Popen`.

    The kernel acts when the *thread* that started the program ends. Outside the main thread a new thread starts it
    therefore, and stays until the program has ended.
    """
    parent = os.getpid()

    def tie() -> None:
        end_with_parent()
        if os.getppid() != parent:  # the parent ended before the call
            os.kill(os.getpid(), signal.SIGKILL)

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, preexec_fn=tie, **options)  # noqa: PLW1509, S603 - two calls into C; ours

    if current_thread() is main_thread():
        return start()
    started: Future[subprocess.Popen[bytes]] = Future()

    def start_and_stay() -> None:
        try:
            child = start()
        except BaseException as error:  # noqa: BLE001 - raised in the caller
            started.set_exception(error)
            return
        started.set_result(child)
        with suppress(ChildProcessError):  # the caller has waited for it
            os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)

    Thread(target=start_and_stay, name="starter", daemon=True).start()
    return started.result()
