"""Options of a transport: the base class of their models, which is that of every configuration, and a payload.

An option is the client's business unless its ``side`` says that the server's process is told too (`SERVER`), or that
it is about a server that somebody runs by itself (`SERVING`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator

from s2a_bench import options as base
from s2a_bench.errors import UsageError

PAYLOADS: Final = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
"""How a picture travels: ``bgr8`` pixels, the camera's own YUYV, JPEG, a JPEG that was at hand before, PNG."""

LOSSLESS: Final = frozenset({"", "raw", "yuyv", "png"})
"""Payloads after which the engine sees the camera's very pixels; "" where nothing travels."""

SERVER: Final = "server"
"""``side`` of an option that the server's process is told too: cells that differ in it get servers of their own."""

SERVING: Final = "serving"
"""``side`` of such an option that is a flag of `serve` only; a run has it in the name of a pipeline."""


def _known(payload: str) -> str:
    if payload and payload not in PAYLOADS:
        raise ValueError(f"'{payload}' is none of {', '.join(PAYLOADS)}")
    return payload


Payload = Annotated[str, AfterValidator(_known)]
"""One of `PAYLOADS`, or nothing."""


class Options(base.Options):
    """What every transport can be told; a transport without options of its own uses this class."""

    payload: Payload = base.option("", f"how a picture travels: {', '.join(PAYLOADS)} [default: the transport's own]")


O = TypeVar("O", bound=Options)  # noqa: E741 - the one type variable here


def server_side(options: Options) -> tuple[tuple[str, Any], ...]:
    """Return name and value of the options that a server's process is told."""
    return tuple((name, getattr(options, name)) for name, side in sides(type(options)) if side)


def sides(model: type[Options]) -> Iterator[tuple[str, str]]:
    """Yield every option with its side, "" the client's."""
    for name, field in model.model_fields.items():
        yield name, str(base.extra_of(field).get("side", ""))


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
