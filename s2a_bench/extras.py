"""Optional libraries: the extra of this package for each, and the one line about a missing one.

No optional library is imported by a statement: ``gguf = extras.require("gguf", "model")``. Plug-ins say what their
extras are for with entry points of the group ``s2a_bench.extras``, each a text.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from s2a_bench.errors import MissingExtra
from s2a_bench.registry import Registry

_CORE: Final = {
    "model": "GGUF model files",
    "llama": "the llama engine",
    "llama-server": "llama.cpp's own server, without a compiler",
    "ccrb": "the embedded simulator",
    "nvidia": "load, memory and power of NVIDIA GPUs",
    "ray": "sweeps, and fleets of robots, on a Ray cluster",
}
_OFFERED: Final[Registry[str]] = Registry("extras", "extra", {})
_NOTED: ContextVar[dict[str, None] | None] = ContextVar("extras that are missing", default=None)


def purposes() -> dict[str, str]:
    return {**_CORE, **dict(_OFFERED.loaded())}


def _purpose(extra: str) -> str:
    return purposes().get(extra, extra)  # a package need not have said what its extra is for


def installed(module: str) -> bool:
    """Whether a top-level module could be imported, without importing it."""
    return sys.modules[module] is not None if module in sys.modules else find_spec(module) is not None


def need(extra: str, *modules: str) -> None:
    """Raise MissingExtra if a top-level module of an extra is not installed, without importing it."""
    if missing := [module for module in modules if not installed(module)]:
        if (noted := _NOTED.get()) is not None:
            noted[extra] = None
            return
        raise MissingExtra(f"{_purpose(extra)}: the package {missing[0]} is not installed; {how_to_install(extra)}")


@contextmanager
def noted() -> Iterator[dict[str, None]]:
    """Yield the extras that `need` finds missing in this context, in which it raises nothing."""
    missing: dict[str, None] = {}
    token = _NOTED.set(missing)
    try:
        yield missing
    finally:
        _NOTED.reset(token)


def require(module: str, extra: str) -> Any:
    """Import and return a module, as ``gguf.constants``; raises MissingExtra if it is missing or does not load."""
    need(extra, module.partition(".")[0])
    try:
        return import_module(module)
    except (ImportError, OSError, RuntimeError) as error:
        raise MissingExtra(f"{_purpose(extra)}: {module} does not load ({error}); {how_to_install(extra)}") from error


def how_to_install(*extras: str) -> str:
    """Return the command that installs extras, and where: the package is on no index."""
    return f"pip install '.[{','.join(extras)}]' in the clone of s2a-bench"
