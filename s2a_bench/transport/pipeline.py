"""Pipeline names, the same in flags, sweeps, tables and code: ``transport[/variant][?option=value&...]``.

``http`` stands for the variants that are measured by default, ``http/binary`` for one, ``ros/topic?payload=yuyv`` for
one with an option. A cell's *canonical* name has the variant, omits options that have their default, and sorts the
others. Values are percent-encoded (RFC 3986): a comma is ``%2C``. In some commands a name may end with options of the
engine: ``loopback?flash_attention=on``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar
from urllib.parse import parse_qsl, quote

from s2a_bench.errors import UsageError
from s2a_bench.options import extra_of
from s2a_bench.text import like
from s2a_bench.transport import (
    ACTIONS,
    EXTERNAL,
    PREENCODED,
    PROGRAM,
    SERVER,
    SERVING,
    TOKENS,
    TRANSPORTS,
    YUYV,
    Capabilities,
    Choice,
    Transport,
    TransportOptions,
    Wiring,
)

O = TypeVar("O", bound=TransportOptions)  # noqa: E741 - the one type variable here


@dataclass(frozen=True)
class Pipeline:
    name: str
    """The name of its cell: canonical, unless a command chooses another."""
    transport: Transport[Any]
    variant: str
    options: TransportOptions
    engine: tuple[tuple[str, str], ...] = ()
    """Options of the engine, with their values, for this cell alone."""

    @property
    def payload(self) -> str:
        return self.options.payload if self.transport.payloads else ""

    @property
    def preencoded(self) -> bool:
        """Whether pictures are JPEGs before the run, as of a camera that delivers them."""
        return self.payload == PREENCODED

    @property
    def black_box(self) -> bool:
        return bool(self.options.external)

    @cached_property
    def capabilities(self) -> Capabilities[Any]:
        return self.transport.capabilities(Choice(self.options, self.variant))

    @cached_property
    def server(self) -> tuple[object, ...]:
        """The key of a server: cells that have it in common share one."""
        kind = "" if self.black_box else self.capabilities.server
        names = self.options.of_sides(SERVER, SERVING, EXTERNAL, PROGRAM)
        return (self.transport.name, kind, *((name, getattr(self.options, name)) for name in names), *self.engine)

    def risks(self) -> Iterator[tuple[str, str, str]]:
        """Yield the risks of the options in its name, as `TransportOptions.risks` does."""
        fields = type(self.options).model_fields
        for name, value in _parse(self.name)[2].items():
            if name in fields and (risk := str(extra_of(fields[name]).get("risk", ""))):
                yield name, risk, value

    def wiring(self, address: str = "", **settings: Any) -> Wiring[Any]:
        """Return the settings of its client or server; ``settings`` are further fields of `Wiring`."""
        return Wiring(self.transport.name, self.variant, self.options, address, self.black_box, **settings)


def _parse(text: str) -> tuple[str, str, dict[str, str]]:
    """Return the transport, the variant and the options of a name as written, unchecked."""
    path, _, query = text.partition("?")
    transport, _, variant = path.partition("/")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise UsageError(f"`transport`: '{text}' should look like {path}?option=value&option=value") from error
    return transport, variant, {name.replace("-", "_"): value for name, value in pairs}


def pipelines(
    names: Iterable[str],
    options: Mapping[str, Mapping[str, Any]] | None = None,
    engine: str = "",
    of_engine: Collection[str] = (),
    *,
    every: bool = True,
    payloads: Sequence[str] = (),
    strict: bool = True,
    mode: str = "",
) -> list[Pipeline]:
    """Return the pipelines that names stand for, each once; raises UsageError.

    Options in a name take precedence over ``options`` (transport -> option -> value). A name without a payload stands
    for each of the ``payloads`` that it can carry in the ``mode``; if it can carry none it gets the first if
    ``strict``, which `require_payload` refuses, else its default. A name without a variant stands for ``every`` variant
    that is measured by default, or for the first. ``of_engine`` are options of the engine that names may hold as well.
    """
    options_of = {name: dict(values) for name, values in (options or {}).items()}
    by_name: dict[str, Pipeline] = {}
    for text in names:
        for pipeline in _standing_for(text, options_of, payloads, mode, engine, of_engine, strict=strict, every=every):
            by_name.setdefault(pipeline.name, pipeline)
    return list(by_name.values())


def answer_over(kind: str, compared: Sequence[Pipeline]) -> str:
    """Return the kind of all answers, so that all pipelines do the same work; raises UsageError.

    For ``auto`` it is tokens, or actions if one of the pipelines carries nothing else.
    """
    alone = {each: carries_alone(each, compared) for each in (TOKENS, ACTIONS)}
    answer = (ACTIONS if alone[ACTIONS] else TOKENS) if kind == "auto" else kind
    if stuck := alone[TOKENS if answer == ACTIONS else ACTIONS]:
        other = f", and {alone[ACTIONS]} nothing else" if answer == ACTIONS and alone[ACTIONS] else ""
        raise UsageError(f"`answer`: {stuck} does not carry {answer}{other}; measure it in a run of its own")
    return answer


def carries_alone(kind: str, compared: Sequence[Pipeline]) -> str:
    """Return the first pipeline whose answers can be of this kind alone, or ""."""
    return next((each.name for each in compared if each.capabilities.answer_kinds == (kind,)), "")


def one_pipeline(text: str, **options: Any) -> Pipeline:
    """Return one pipeline of a name, with the first variant if it names none; ``options`` are those of flags."""
    return pipelines([text], {_parse(text)[0]: options}, every=False)[0]


def _standing_for(
    text: str,
    flags_of: Mapping[str, Mapping[str, Any]],
    wanted: Sequence[str],
    mode: str,
    engine: str,
    of_engine: Collection[str],
    *,
    strict: bool,
    every: bool,
) -> Iterator[Pipeline]:
    name, named_variant, written = _parse(text)
    transport = TRANSPORTS[name]
    flags = flags_of.get(transport.name, {})
    own = {name: value for name, value in written.items() if name not in of_engine}
    engine_options = tuple(sorted(written.items() - own.items()))
    plain = _checked(transport.options, flags, transport.name)
    options = _checked(transport.options, {**flags, **own}, transport.name)
    only = wanted[0] if strict and len(wanted) == 1 else ""
    measured = transport.measured(Choice(_filled(options, only), engine=engine))
    variants = [named_variant] if named_variant else measured[: None if every else 1]
    for variant in variants:
        if variant not in (transport.variants or ("",)):
            names = ", ".join(transport.variants) or "variants: it has none"
            meant = like(variant, transport.variants)
            raise UsageError(f"`transport`: '{variant}' is not one of {transport.name}'s {names}{meant}")
        can = transport.capabilities(Choice(options, variant, mode=mode))
        refused = wanted[:1] if strict and can.payloads else ()  # by `require_payload`
        payloads = [each for each in wanted if each in can.payloads] or refused or can.payloads[:1] or ("",)
        if variant != variants[0] and not options.payload and payloads[0] not in {*can.payloads, ""}:
            continue  # it is not named, and can carry none of them
        default = _filled(plain, payloads[0])
        for payload in payloads[: 1 if options.payload else None]:
            name = _canonical(transport, variant, _filled(options, payload), default, engine_options)
            yield Pipeline(name, transport, variant, _filled(can.options, payload), engine_options)


def _checked(model: type[O], values: Mapping[str, Any], owner: str) -> O:
    for name in values:
        if name not in model.model_fields:
            fields = model.model_fields
            raise UsageError(
                f"`transport`: {owner} has no option '{name}'; it has {', '.join(fields)}{like(name, fields)}"
            )
    return model(**values)


def _filled(options: O, payload: str) -> O:
    return options if options.payload else options.model_copy(update={"payload": payload})


def require_payload(pipeline: Pipeline, mode: str, *, resized: bool) -> None:
    """Raise UsageError for a payload that the pipeline cannot carry, or that cannot be resized or streamed."""
    if resized and pipeline.payload in {YUYV, PREENCODED}:
        raise UsageError(f"`resize`: {pipeline.payload} is what the camera gave; use `payload` raw, jpeg or png")
    if mode == "stream" and pipeline.preencoded:
        raise UsageError(f"`payload` {PREENCODED} has no meaning in `mode` stream; use jpeg")
    can = pipeline.transport.capabilities(Choice(pipeline.options, pipeline.variant, mode)).payloads
    if pipeline.payload and pipeline.payload not in can:
        path = pipeline.name.partition("?")[0]
        raise UsageError(
            f"`payload`: {path} can send a picture as {', '.join(can)}, not as {pipeline.payload}; choose one for this "
            f"transport alone: {path}?payload={can[0]}"
        )


def without(name: str, option: str) -> str:
    path, _, query = name.partition("?")
    kept = "&".join(each for each in query.split("&") if each.partition("=")[0] != option)
    return f"{path}?{kept}" if kept else path


def _canonical(
    transport: Transport[Any],
    variant: str,
    options: TransportOptions,
    default: TransportOptions,
    engine: Iterable[tuple[str, str]],
) -> str:
    path = f"{transport.name}/{variant}" if variant else transport.name
    values = [(name, getattr(options, name)) for name in sorted(type(options).model_fields)]
    named = [*((name, value) for name, value in values if value != getattr(default, name)), *engine]
    query = "&".join(f"{name}={quote(_text(value), safe='/:@')}" for name, value in named)
    return f"{path}?{query}" if query else path


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
