"""s2a-bench measures the transport between a robot and a vision-language model, and when the robot may act.

Every experiment is a function (`latency`, `throughput`, `timeline`, those of plug-ins), `load` opens a run folder,
`compare` compares two. See docs/library.md; the types are in __init__.pyi.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Any

__version__ = "0.1.0"

os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "50000000")  # OpenCV reads it when it is loaded

_LIBRARY = ("Comparison", "Run", "compare", "load")


def __getattr__(name: str) -> Any:
    """Import the library at the first use of a name, so that importing the package stays fast."""
    if find_spec(f"s2a_bench.{name}"):
        raise AttributeError(f"the module 's2a_bench.{name}' is not imported")
    from s2a_bench.experiments import EXPERIMENTS

    if name == "__all__":
        return sorted((*_LIBRARY, *(each for each, _ in EXPERIMENTS.loaded() if each.isidentifier())))
    if name not in _LIBRARY and name not in EXPERIMENTS:
        raise AttributeError(f"module 's2a_bench' has no attribute '{name}'")
    from s2a_bench import library

    member = globals()[name] = getattr(library, name) if name in _LIBRARY else library.command(name)
    return member


def __dir__() -> list[str]:
    return [*__getattr__("__all__"), "__version__"]
