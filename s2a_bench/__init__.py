"""s2a-bench measures the transport between a robot and a vision-language model, and when the robot may act.

Every experiment is a function (`latency`, `throughput`, `timeline`, `chunks`, `capacity`, `boundary`, `ccrb`), `load`
opens a run folder, `compare` compares two. See docs/library.md; the types are in __init__.pyi.
"""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"

__all__ = [
    "Comparison",
    "Run",
    "boundary",
    "capacity",
    "ccrb",
    "chunks",
    "compare",
    "latency",
    "load",
    "throughput",
    "timeline",
]


def __getattr__(name: str) -> Any:
    """Import the library at the first use of a name, so that importing the package stays fast."""
    if name not in __all__:
        raise AttributeError(f"module 's2a_bench' has no attribute '{name}'")
    from s2a_bench import library

    found = getattr(library, name, None) or library.command(name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
