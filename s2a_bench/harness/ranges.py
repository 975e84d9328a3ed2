"""How a configuration refuses numbers that are out of range: one line that names the flag."""

from __future__ import annotations

import math
from collections.abc import Iterable

from s2a_bench.errors import UsageError


def require(flag: str, values: Iterable[float], least: float, most: float = math.inf, *, above: bool = False) -> None:
    """Refuse values out of a range, of which ``above`` leaves out the lower end; infinity never is in it."""
    for value in values:
        if not (least < value if above else least <= value) or not value <= most or math.isinf(value):
            bound = f"above {least:g}" if above else f"{least:g} or more"
            limit = f" and at most {most:.3g}" if most < math.inf else ""
            raise UsageError(f"{flag}: {value:g} should be {bound}{limit}")
