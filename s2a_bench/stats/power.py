"""What a test could have seen: the smallest change that it finds at the noise that was measured, and how often."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

POWER: Final = 0.8
"""The share of repeats in which the smallest change that counts as seen is found (Cohen 1988)."""

_MOST: Final = 50.0
"""Logarithm beyond which a ratio is not worth telling from infinity."""


@dataclass(frozen=True, slots=True)
class Noise:
    """The standard error of a change with its degrees of freedom: of a logarithm, or as a share of the baseline."""

    error: float
    freedom: float
    logarithmic: bool = True

    def detectable(self, level: float, *, falls: bool = False, power: float = POWER) -> float:
        """Return the smallest rise (or fall), as a share of the baseline, that a two-sided t test finds so often."""
        from scipy import special, stats

        if not self.error:
            return 0.0
        critical = float(stats.t.isf(level / 2, self.freedom))
        shift = float(special.nctdtrinc(self.freedom, 1 - power, critical)) * self.error
        if not self.logarithmic:
            return shift
        return -math.expm1(-shift) if falls else math.expm1(min(shift, _MOST))

    def power(self, change: float, level: float) -> float:
        """Return how often the test finds a change of this share."""
        from scipy import stats

        shift = math.log1p(change) if self.logarithmic else change
        if not self.error:
            return float(shift != 0)
        critical = float(stats.t.isf(level / 2, self.freedom))
        return float(stats.nct.sf(critical, self.freedom, abs(shift) / self.error))
