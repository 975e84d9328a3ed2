"""Child processes that never outlive the process that started them, however it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from threading import Thread, current_thread, main_thread
from typing import Any, Final

PR_SET_PDEATHSIG: Final = 1
_prctl = ctypes.CDLL(None).prctl


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
