"""Bounds and descriptions of fields, in terms of JSON Schema: annotations from which docs/schema follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any


class Facts(dict[str, Any]):
    """An annotation of a field in terms of JSON Schema; hashable, so that ``| None`` may follow."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self))

    def __get_pydantic_json_schema__(self, core: Any, schema_of: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        return schema_of(core) | self


Count = Annotated[int, Facts(minimum=0)]
Many = Annotated[int, Facts(minimum=1)]
NonNegative = Annotated[float, Facts(minimum=0)]
Positive = Annotated[float, Facts(exclusiveMinimum=0)]
Fraction = Annotated[float, Facts(minimum=0, maximum=1)]


def about(description: str) -> Facts:
    return Facts(description=description)
