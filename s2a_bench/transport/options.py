"""Options of a transport: the base class of their models, which is that of every configuration, and a payload.

An option is the client's business unless its field says `json_schema_extra=SERVER`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, Field

from s2a_bench import options as base
from s2a_bench.errors import UsageError

PAYLOADS: Final = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
"""How a picture travels: ``bgr8`` pixels, the camera's own YUYV, JPEG, a JPEG that was at hand before, PNG."""

LOSSLESS: Final = frozenset({"", "raw", "yuyv", "png"})
"""Payloads after which the engine sees the camera's very pixels; "" where nothing travels."""

SERVER: Final[dict[str, Any]] = {"side": "server"}
"""``json_schema_extra`` of an option that the server's process is told too: cells that differ in it get their own."""


def _known(payload: str) -> str:
    if payload and payload not in PAYLOADS:
        raise ValueError(f"'{payload}' is none of {', '.join(PAYLOADS)}")
    return payload


class Options(base.Options):
    """What every transport can be told; a transport without options of its own uses this class."""

    payload: Annotated[str, AfterValidator(_known)] = Field(
        "", description="how a picture travels: raw, yuyv, jpeg, jpeg-preencoded, png [default: the transport's own]"
    )


O = TypeVar("O", bound=Options)  # noqa: E741 - the one type variable here


def server_side(options: Options) -> tuple[tuple[str, Any], ...]:
    """Return name and value of the options that a server's process is told."""
    return tuple((name, getattr(options, name)) for name in _server_fields(type(options)))


def _server_fields(model: type[Options]) -> Iterator[str]:
    for name, field in model.model_fields.items():
        if isinstance(field.json_schema_extra, dict) and field.json_schema_extra.get("side") == SERVER["side"]:
            yield name


def checked(model: type[O], values: Mapping[str, Any], owner: str) -> O:
    """Make a model of values, texts included; raises UsageError, naming what is wrong and what there is."""
    for name in values:
        if name not in model.model_fields:
            raise UsageError(f"`transport`: {owner} has no option '{name}'; it has {', '.join(model.model_fields)}")
    return model(**values)


def text_of(value: Any) -> str:
    """Return a value as it stands in a pipeline's name."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
