"""Between what numbers lie, as rows and the cells of ``--json`` declare it; docs/schema follows from that."""

from __future__ import annotations

from typing import Annotated, Any


class Facts(dict[str, Any]):
    """What an annotation says of a field, in the words of JSON Schema; hashable, so that ``| None`` may follow."""

    def __hash__(self) -> int:  # type: ignore[override]
        """Hash the names."""
        return hash(tuple(self))


Count = Annotated[int, Facts(minimum=0)]
Many = Annotated[int, Facts(minimum=1)]
NonNegative = Annotated[float, Facts(minimum=0)]
Positive = Annotated[float, Facts(exclusiveMinimum=0)]
Fraction = Annotated[float, Facts(minimum=0, maximum=1)]


def about(description: str) -> Facts:
    """Return what an annotation says of a field for people."""
    return Facts(description=description)
