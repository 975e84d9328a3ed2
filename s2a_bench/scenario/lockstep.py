"""Memory of M roll-outs in lock step, from which those that are decided drop out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class LockStep:
    """Something that remembers: each of its arrays has the roll-outs along its last axis."""

    def keep(self, columns: NDArray[np.int64]) -> None:
        """Go on with these roll-outs only."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, value[..., columns])
            elif isinstance(value, LockStep):
                value.keep(columns)
