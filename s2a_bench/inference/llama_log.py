"""Keep llama.cpp's log in memory, for the reasons of errors, instead of on stderr."""

from __future__ import annotations

import ctypes
import os
import re
from collections import deque
from typing import Any

from s2a_bench import extras

llama_cpp = extras.require("llama_cpp", "llama")
mtmd_cpp = extras.require("llama_cpp.mtmd_cpp", "llama")

VARIABLE = "S2A_BENCH_LLAMA_LOG"
"""The environment variable with which, set to 1, llama.cpp writes to stderr."""

_ERROR = 4  # GGML_LOG_LEVEL_ERROR of ggml.h; the bindings' own list is out of date
_lines: deque[str] = deque(maxlen=20)


def _keep(level: int, text: bytes, _user_data: Any) -> None:
    if level == _ERROR:
        _lines.append(text.decode(errors="replace").strip())


_callback = llama_cpp.llama_log_callback(_keep)  # must outlive the library's use of it


def verbose() -> bool:
    return os.environ.get(VARIABLE) == "1"


def silence() -> None:
    """Keep the log of llama.cpp, ggml and MTMD in memory, unless it is `verbose`."""
    if verbose():
        return
    nothing = ctypes.c_void_p(0)
    llama_cpp.llama_log_set(_callback, nothing)
    mtmd_cpp.mtmd_log_set(_callback, nothing)
    mtmd_cpp.mtmd_helper_log_set(_callback, nothing)


def reason() -> str:
    """Return the first error logged since the last call, without the function's name; "" if there is none."""
    first = _lines[0] if _lines else ""
    _lines.clear()
    return re.sub(r"^[a-z_]+: ", "", first.partition("\n")[0])
