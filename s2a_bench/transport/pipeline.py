"""Pipeline names, the same in flags, sweeps, tables and code: ``transport[/variant][?option=value&...]``.

``http`` stands for the variants that are measured by default, ``http/binary`` for one, ``ros/topic?payload=yuyv`` for
one with an option of its own. A cell's *canonical* name has the variant, leaves out options that are what they would be
without being named, and sorts the others. Values are percent-encoded where they need to be (RFC 3986): a comma is
``%2C``.
Where a command says so a name may hold options of the engine too, which come last: ``loopback?flash_attention=on``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar
from urllib.parse import parse_qsl, quote

from s2a_bench.errors import UsageError
from s2a_bench.options import extra_of
from s2a_bench.text import like
from s2a_bench.transport import (
    ACTIONS,
    EXTERNAL,
    PROGRAM,
    SERVER,
    SERVING,
    TOKENS,
    TRANSPORTS,
    Capabilities,
    Choice,
    Transport,
    TransportOptions,
    Wiring,
)

O = TypeVar("O", bound=TransportOptions)  # noqa: E741 - the one type variable here


@dataclass(frozen=True, slots=True)
class Pipeline:
    """One pipeline with its settings: what is compared."""

    name: str
    """What its cell is called: canonical, unless a command has a word of its own."""
    transport: Transport[Any]
    variant: str
    options: TransportOptions
    engine: tuple[tuple[str, str], ...] = ()
    """Options of the engine, with their values, that only this cell's has."""

    @property
    def payload(self) -> str:
        """Return how a picture travels; nothing where it does not."""
        return self.options.payload if self.transport.payloads else ""

    @property
    def black_box(self) -> bool:
        """Whether the server is not ours."""
        return bool(self.options.external)

    @property
    def capabilities(self) -> Capabilities[Any]:
        """Return what it can carry."""
        return self.transport.capabilities(Choice(self.options, self.variant))

    @property
    def server(self) -> tuple[object, ...]:
        """Return what cells must have in common to share a server."""
        ours = "" if self.black_box else self.capabilities.server
        told = self.options.of_sides(SERVER, SERVING, EXTERNAL, PROGRAM)
        return (self.transport.name, ours, *((name, getattr(self.options, name)) for name in told), *self.engine)

    def risks(self) -> Iterator[tuple[str, str, str]]:
        """Yield those of the options in its name, as `TransportOptions.risks` does."""
        fields = type(self.options).model_fields
        for name, value in _parse(self.name).options.items():
            if name in fields and (risk := str(extra_of(fields[name]).get("risk", ""))):
                yield name, risk, value

    def wiring(self, address: str = "", **told: Any) -> Wiring[Any]:
        """Return what its client, or its server, is told."""
        return Wiring(self.transport.name, self.variant, self.options, address, self.black_box, **told)


@dataclass(frozen=True, slots=True)
class _Named:
    """A name as written: the parts, unchecked."""

    transport: str
    variant: str
    options: dict[str, str]


def _parse(text: str) -> _Named:
    """Take a name apart; raises UsageError for options that are no ``option=value``."""
    path, _, query = text.partition("?")
    transport, _, variant = path.partition("/")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise UsageError(f"`transport`: '{text}' should look like {path}?option=value&option=value") from error
    return _Named(transport, variant, {name.replace("-", "_"): value for name, value in pairs})


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

    ``options`` (transport -> option -> value) hold what flags give, for names that do not say it themselves. A name
    that says no payload stands for a pipeline with each of the ``payloads`` that it can carry in the ``mode``; one that
    can carry none of them gets the first if ``strict``, which `require_payload` refuses, else its own. A name without a
    variant stands for ``every`` one that is measured by default, or for the first of them; ``engine`` is what answers,
    as that may decide which they are. ``of_engine`` are options of it that names may hold as well.
    """
    given = {name: dict(values) for name, values in (options or {}).items()}
    found: dict[str, Pipeline] = {}
    for text in names:
        wanted = _Payloads(tuple(payloads), strict=strict, mode=mode)
        for pipeline in _standing_for(_parse(text), given, wanted, engine, of_engine, every=every):
            found.setdefault(pipeline.name, pipeline)
    return list(found.values())


@dataclass(frozen=True, slots=True)
class _Payloads:
    """How pictures are to travel: see `pipelines`."""

    names: tuple[str, ...] = ()
    strict: bool = False
    mode: str = ""

    @property
    def only(self) -> str:
        """Return what all pipelines have to carry, or nothing."""
        return self.names[0] if self.strict and len(self.names) == 1 else ""

    def over(self, can: Sequence[str]) -> Sequence[str]:
        """Return those for a pipeline that ``can`` carry some; nothing where no picture travels."""
        if not can:
            return ("",)
        return [each for each in self.names if each in can] or ((self.strict and self.names) or can)[:1]


def answer_over(asked: str, compared: Sequence[Pipeline]) -> str:
    """Return what all answers are made of, so that all pipelines do the same work; raises UsageError.

    Where that is left open (``auto``) it is tokens, actions if one of the pipelines carries nothing else.
    """
    alone = {kind: carries_alone(kind, compared) for kind in (TOKENS, ACTIONS)}
    answer = (ACTIONS if alone[ACTIONS] else TOKENS) if asked == "auto" else asked
    if stuck := alone[TOKENS if answer == ACTIONS else ACTIONS]:
        other = f", and {alone[ACTIONS]} nothing else" if answer == ACTIONS and alone[ACTIONS] else ""
        raise UsageError(f"`answer`: {stuck} does not carry {answer}{other}; measure it in a run of its own")
    return answer


def carries_alone(kind: str, compared: Sequence[Pipeline]) -> str:
    """Return the first pipeline whose answers can be made of nothing else, "" without one."""
    return next((each.name for each in compared if each.capabilities.answer_kinds == (kind,)), "")


def one_pipeline(text: str, **options: Any) -> Pipeline:
    """Return the one pipeline of a name, its first variant where it names none; ``options`` are as if by flags."""
    named = _parse(text)
    return next(_standing_for(named, {named.transport: options}, _Payloads(), every=False))


def _standing_for(
    named: _Named,
    given: Mapping[str, Mapping[str, Any]],
    wanted: _Payloads,
    engine: str = "",
    of_engine: Collection[str] = (),
    *,
    every: bool,
) -> Iterator[Pipeline]:
    transport = TRANSPORTS[named.transport]
    flags = given.get(transport.name, {})
    told = {name: value for name, value in named.options.items() if name not in of_engine}
    own = tuple(sorted(named.options.items() - told.items()))
    plain = _checked(transport.options, flags, transport.name)
    asked = _checked(transport.options, {**flags, **told}, transport.name)
    alike = asked if asked.payload else asked.model_copy(update={"payload": wanted.only})
    measured = transport.measured(Choice(alike, engine=engine))
    variants = [named.variant] if named.variant else measured if every else measured[:1]
    for variant in variants:
        if variant not in (transport.variants or ("",)):
            known = ", ".join(transport.variants) or "none: it has no variants"
            meant = like(variant, transport.variants)
            raise UsageError(f"`transport`: '{variant}' is none of {transport.name}'s {known}{meant}")
        can = transport.capabilities(Choice(asked, variant, mode=wanted.mode))
        payloads = wanted.over(can.payloads)
        if variant != variants[0] and not asked.payload and payloads[0] not in {*can.payloads, ""}:
            continue  # nobody named it, and it can carry none of them
        default = _filled(plain, payloads[0])
        for payload in payloads[: 1 if asked.payload else None]:
            name = _canonical(transport, variant, _filled(asked, payload), default, own)
            yield Pipeline(name, transport, variant, _filled(can.options, payload), own)


def _checked(model: type[O], values: Mapping[str, Any], owner: str) -> O:
    """Make a model of values, texts included; raises UsageError, naming what is wrong and what there is."""
    for name in values:
        if name not in model.model_fields:
            known = model.model_fields
            raise UsageError(
                f"`transport`: {owner} has no option '{name}'; it has {', '.join(known)}{like(name, known)}"
            )
    return model(**values)


def _filled(options: O, payload: str) -> O:
    return options if options.payload else options.model_copy(update={"payload": payload})


def require_payload(pipeline: Pipeline) -> None:
    """Raise UsageError where a picture cannot travel as it should."""
    can = pipeline.capabilities.payloads
    if pipeline.payload and pipeline.payload not in can:
        path = pipeline.name.partition("?")[0]
        raise UsageError(
            f"`payload`: over {path} a picture travels as {', '.join(can)}, not {pipeline.payload}; say it for this "
            f"transport alone: {path}?payload={can[0]}"
        )


def without(name: str, option: str) -> str:
    """Return a cell's name without one of its options."""
    path, _, query = name.partition("?")
    kept = "&".join(each for each in query.split("&") if each.partition("=")[0] != option)
    return f"{path}?{kept}" if kept else path


def _canonical(
    transport: Transport[Any],
    variant: str,
    options: TransportOptions,
    default: TransportOptions,
    own: Iterable[tuple[str, str]],
) -> str:
    """Write the name of a cell, the engine's ``own`` options last."""
    path = f"{transport.name}/{variant}" if variant else transport.name
    said = [(name, getattr(options, name)) for name in sorted(type(options).model_fields)]
    named = [*((name, value) for name, value in said if value != getattr(default, name)), *own]
    query = "&".join(f"{name}={quote(_text(value), safe='/:@')}" for name, value in named)
    return f"{path}?{query}" if query else path


def _text(value: Any) -> str:
    """Return a value as it stands in a pipeline's name."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
