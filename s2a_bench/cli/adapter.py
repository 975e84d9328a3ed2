"""Turn the fields of a configuration into typer's options; nothing else does."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from keyword import iskeyword
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import typer

from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from s2a_bench.experiments import Experiment, RunMode
    from s2a_bench.options import Options

FIELD = re.compile(r"`([a-z][a-z0-9_]*)`")
DEFAULT = re.compile(r" ?\[default: ([^\]]*)\]$")
PLAIN: tuple[type, ...] = (bool, int, float, Path)
"""Types that typer reads; every other type is read from text by its field."""
MANY = 16
"""A command with more flags than this shows only the `first` ones in its help."""
HELP_ALL = "help_all"
"""The parameter that shows every flag, and its key in a context's `meta`."""


@dataclass(frozen=True, slots=True)
class Flag:
    name: str
    """Without dashes: max-tokens."""
    path: tuple[str, ...]
    """The field, preceded by the groups that it is in."""
    kind: type
    about: str
    needed: bool = False
    argument: bool = False
    hidden: bool = False
    prefix: str = ""
    panel: str = ""
    first: bool = False
    """True if the help of a command with many flags shows it."""
    names: Callable[[], Iterable[str]] | None = None

    @property
    def spelled(self) -> str:
        return self.name.upper() if self.argument else f"--{self.name}"

    @property
    def parameter(self) -> inspect.Parameter:
        """Return a parameter of the function that typer reads; None means that it was not given."""
        default, about = inspect.Parameter.empty if self.needed else None, with_flags(self.prefix + self.about)
        shown: dict[str, Any] = {"help": about, "show_default": False}
        if self.argument:
            several = "..." if get_origin(self.kind) is list else ""
            declared: Any = typer.Argument(metavar=f"{self.spelled}{several}", **shown)
        else:
            declared = typer.Option(self.spelled, hidden=self.hidden, rich_help_panel=self.panel or None, **shown)
        if self.names:
            declared.autocompletion = _completion(self.names)
        kind: Any = self.kind if self.needed else Union[self.kind, None]  # noqa: UP007 - made at run time
        return inspect.Parameter(
            self.key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, declared]
        )

    @property
    def key(self) -> str:
        """Its name as a parameter of Python: ``in_`` for a keyword."""
        key = self.name.replace("-", "_")
        return f"{key}_" if iskeyword(key) else key


def _flags_of_modes(experiment: Experiment) -> Iterator[Flag]:
    """Yield the flags that pick a mode, and those of all modes, each once; their headings say which modes have them."""
    modes = experiment.every_mode
    for flag, about in (pair for mode in modes for pair in mode.flags.items()):
        if about:
            yield Flag(flag.replace("_", "-"), (flag,), bool, about, panel="Modes", first=True)
    by_name: dict[str, dict[RunMode, Flag]] = {}
    for mode in modes:
        for each in distinct([*flags_of(mode.options)]):
            by_name.setdefault(each.name, {})[mode] = each
    for of_mode in by_name.values():
        first = next(iter(of_mode.values()))
        panel = f"{first.panel or 'Options'}{_with(modes, of_mode)}"
        about = _with_defaults({mode.name: each.about for mode, each in of_mode.items()})
        yield replace(first, panel=panel, about=about, needed=False)


def _picked(experiment: Experiment, values: Mapping[str, Any]) -> type[Options]:
    """Return the class of the mode that the flags pick; raises UsageError for options of another."""
    modes = experiment.every_mode
    picking = {flag for mode in modes for flag in mode.flags if values.get(flag)}
    mode = next((each for each in modes if {*each.flags} == picking), None)
    if mode is None:
        given_flags = " and ".join(f"`{flag}`" for flag in sorted(picking))
        more = next(({*each.flags} - picking for each in modes if picking < {*each.flags}), None)
        raise UsageError(f"{given_flags} needs `{min(more)}`" if more else f"{given_flags} exclude each other")
    for name, value in values.items():
        other = None if value is None else experiment.other_mode(mode, name)
        if other and (value or name not in other.flags):
            missing = [f"give `{flag}`" for flag in other.flags if flag not in mode.flags]
            spare = [f"leave out `{flag}`" for flag in mode.flags if flag not in other.flags]
            raise UsageError(f"`{name}` is an option of mode {other.name}: {', '.join(missing + spare)}")
    return mode.options


def _with(modes: Sequence[RunMode], owners: Collection[RunMode]) -> str:
    """Return what a heading adds about the flags of the modes that have its options."""
    others = [mode for mode in modes if mode not in owners]
    if not others:
        return ""
    of, word = (others, "not with") if modes[0] in owners else ([*owners], "with")
    common = [flag for flag in of[0].flags if all(flag in mode.flags for mode in of)]
    single = dict.fromkeys(flag for mode in of for flag in mode.flags)
    spelled = (" " if common else " or ").join(f"--{flag.rstrip('_').replace('_', '-')}" for flag in common or single)
    return f" ({word} {spelled})"


def flags_of(options: type[Options] | Experiment) -> Iterator[Flag]:
    """Yield the flags of a configuration, or of an experiment with modes, in the order of fields, groups included."""
    from s2a_bench.options import completions, extra_of, group_of, help_place

    if not isinstance(options, type):
        yield from _flags_of_modes(options)
        return
    for name, field in options.model_fields.items():
        extra = extra_of(field)
        group = group_of(field)
        if group is not None:
            only, about, first = extra.get("only"), extra.get("about", ""), extra.get("first")
            for flag in flags_of(group):
                if not only or flag.path[0] in only:
                    shown = flag.first if first is None else flag.path[0] in first
                    yield replace(flag, path=(name, *flag.path), prefix=f"{about}{flag.prefix}", first=shown)
        else:
            flag_name = str(extra.get("flag") or name.replace("_", "-"))
            kind, argument, hidden = _kind(field.annotation), bool(extra.get("argument")), bool(extra.get("hidden"))
            panel, first = help_place(options, name)
            flag = Flag(flag_name, (name,), kind, _about(field), field.is_required(), argument, hidden)
            yield replace(flag, panel=panel, first=first, names=completions(field))


def command(
    function: Callable[..., None], *options: type[Options] | Experiment, about: str = ""
) -> Callable[..., None]:
    """Return a function for typer that builds every class of ``options`` from its flags and calls ``function``.

    ``function`` receives one configuration a class, in order. Its keyword-only parameters annotated for typer are
    flags too. ``about`` is the text of ``--help``.
    """
    keywords = _keywords(function)
    flags = distinct([flag for each in options for flag in flags_of(each)], taken=keywords)
    listed = [flag for flag in flags if not (flag.hidden or flag.argument)]
    later = [flag.key for flag in listed if not flag.first]
    rest = later if MANY < len(listed) > len(later) else []
    more = [_help_all(len(listed) + len(keywords))] if rest else []

    def run(**values: Any) -> None:
        with flags_named(*options):
            function(*(build(each, values) for each in options), **{name: values[name] for name in keywords})

    run.__signature__ = inspect.Signature([*(flag.parameter for flag in flags), *keywords.values(), *more])  # type: ignore[attr-defined]
    run.__doc__ = about
    run.rest = rest  # type: ignore[attr-defined]
    return run


def _help_all(count: int) -> inspect.Parameter:
    def show(ctx: typer.Context, value: bool) -> None:
        if value and not ctx.resilient_parsing:
            ctx.meta[HELP_ALL] = True
            typer.echo(ctx.get_help())
            raise typer.Exit

    about = f"Show all {count} options and exit."
    flag = typer.Option("--help-all", is_eager=True, expose_value=False, callback=show, help=about)
    return inspect.Parameter(HELP_ALL, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, flag])


def _completion(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a function that completes a name, or the last of several with commas."""

    def complete(incomplete: str) -> list[str]:
        done = incomplete[: incomplete.rfind(",") + 1]
        return [f"{done}{name}" for name in names() if name]

    return complete


def distinct(flags: Sequence[Flag], taken: Iterable[str] = ()) -> list[Flag]:
    """Return the flags whose names are not ``taken``, one for each name."""
    names = {name.strip("_").replace("_", "-") for name in taken}
    return [_shared(same) for same in _by_name(flags) if same[0].name not in names]


def _by_name(flags: Sequence[Flag]) -> Iterator[list[Flag]]:
    """Yield for each name the flags that it sets: the first in the fewest groups, and those in groups beside it."""
    from s2a_bench.options import beside

    owners = {flag.name: flag for flag in sorted(flags, key=lambda flag: len(flag.path))[::-1]}
    for owner in flags:
        if owners[owner.name] is owner:
            same = (each for each in flags if each.name == owner.name and beside(each.path, owner.path))
            yield [owner, *(each for each in same if each is not owner)]


def _shared(flags: Sequence[Flag]) -> Flag:
    """Return one flag for several: its help begins with their groups and ends with the defaults that differ."""
    abouts = {flag.prefix.removesuffix(": "): flag.about for flag in flags}
    if len(abouts) == 1:
        return flags[0]
    return replace(flags[0], prefix=f"{', '.join(abouts)}: ", about=_with_defaults(abouts))


def _with_defaults(abouts: Mapping[str, str]) -> str:
    """Return the first of several helps, by owner, ending with the defaults of all if they differ."""
    first = next(iter(abouts.values()))
    owners: dict[str, list[str]] = {}
    for owner, about in abouts.items():
        if default := DEFAULT.search(about):
            owners.setdefault(default[1], []).append(owner)
    if len(owners) < 2:  # noqa: PLR2004 - they agree
        return first
    defaults = "; ".join(f"{', '.join(names)} {default}" for default, names in owners.items())
    return DEFAULT.sub(f" [default: {defaults}]", first)


def build(options: type[Options] | Experiment, values: Mapping[str, Any]) -> Options:
    """Build a configuration from a command's parameters; raises UsageError naming the field."""
    from s2a_bench.options import nested

    if not isinstance(options, type):
        options = _picked(options, values)
    typed = (flag for same in _by_name([*flags_of(options)]) for flag in same)
    return options(**nested((flag.path, values[flag.key]) for flag in typed if values.get(flag.key) is not None))


@contextmanager
def flags_named(*options: type[Options] | Experiment) -> Iterator[None]:
    """Translate the fields in UsageErrors to the flags of ``options``."""
    try:
        yield
    except UsageError as error:
        spelled = {flag.path[-1]: flag.spelled for each in options for flag in distinct([*flags_of(each)])}
        raise UsageError(with_flags(str(error), spelled)) from error


def with_flags(message: str, spelled: Mapping[str, str] | None = None) -> str:
    """Replace the fields in a message, `max_tokens`, by flags: --max-tokens, or as ``spelled`` has them."""
    return FIELD.sub(lambda field: (spelled or {}).get(field[1]) or f"--{field[1].replace('_', '-')}", message)


def _keywords(function: Callable[..., None]) -> dict[str, inspect.Parameter]:
    every = inspect.signature(function, eval_str=True).parameters.values()
    declared = (each for each in every if each.kind is each.KEYWORD_ONLY and get_origin(each.annotation) is Annotated)
    return {each.name: each for each in declared}


def _kind(annotation: Any) -> type:
    if get_origin(annotation) in {Union, UnionType}:
        annotation = next(arg for arg in get_args(annotation) if arg is not NoneType)
    return annotation if annotation in PLAIN or get_origin(annotation) is list else str


def _about(field: FieldInfo) -> str:
    """Return a field's help, with its default unless the text names it."""
    about = field.description or ""
    default = field.get_default(call_default_factory=False)
    if field.is_required() or "[default" in about or default is None or default is False or default in ("", (), []):
        return about
    values = default if isinstance(default, tuple) else (default,)
    return f"{about} [default: {','.join(f'{each:g}' if isinstance(each, float) else str(each) for each in values)}]"
