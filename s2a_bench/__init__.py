"""s2a-bench: what wiring a vision-language model to a robot costs, and when the robot may act on what it streams.

The library's face: every experiment is a function (`latency`, `throughput`, `timeline`, `chunks`, `boundary`,
`ccrb`), `load` opens a run folder, `compare` compares two. See docs/library.md; their types are in __init__.pyi.
"""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"

__all__ = [
    "Comparison",
    "Run",
    "boundary",
    "ccrb",
    "chunks",
    "compare",
    "latency",
    "load",
    "throughput",
    "timeline",
]


def __getattr__(name: str) -> Any:
    """Import the library when a name of it is first asked for: importing the package stays light."""
    if name not in __all__:
        raise AttributeError(f"module 's2a_bench' has no attribute '{name}'")
    from s2a_bench import library

    found = getattr(library, name, None) or library.command(name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the names of the library."""
    return [*__all__, "__version__"]
