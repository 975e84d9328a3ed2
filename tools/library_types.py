"""Write s2a_bench/__init__.pyi, the types of the library's functions: `.venv/bin/python tools/library_types.py`.

A keyword of a function is an option of its command: by the field's name and, where that is another, by the flag's. Its
type is what the field takes; a validator that reads more says so (`json_schema_input_type`). A function has a signature
a mode. Keywords that several share stand once, in a class.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin

from pydantic import BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from s2a_bench.cli.adapter import distinct, flags_of
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.options import Options, group_of

STUB = Path(__file__).parent.parent / "s2a_bench/__init__.pyi"
NOT_GIVEN = {"name"}
"""What `library.run` calls the experiment: an engine's name has its flag's."""
Mode: TypeAlias = tuple[str, str]
"""A command, and the name of one of its modes; "" for a command without."""
WIDTH = 121
"""Longest line, its end included: as ruff formats the file."""
TOGETHER = 8
"""So many keywords that the same modes have stand once, in a class."""
HEAD = '''# ruff: noqa: PYI021 - editors show what a function does
"""The library's names, and the keywords of its functions. Written by tools/library_types.py."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, TypeAlias, TypedDict, TypeVar, overload

from typing_extensions import Unpack

from s2a_bench.library import Comparison as Comparison
from s2a_bench.library import Run as Run
from s2a_bench.library import compare as compare
from s2a_bench.library import load as load
from s2a_bench.progress import Progress

__version__: str

_T = TypeVar("_T")
_Several: TypeAlias = str | _T | Iterable[_T]  # text has commas between them

class _Run(TypedDict, total=False):
    output: str | Path
    progress: Progress | None
    tune: bool
'''


def type_of(annotation: Any, metadata: Sequence[Any] = ()) -> str:  # noqa: PLR0911 - an annotation, a text
    """Return how a stub writes what a field of this annotation takes."""
    for each in metadata:
        if isinstance(each, BeforeValidator) and each.json_schema_input_type is not PydanticUndefined:
            return type_of(each.json_schema_input_type)
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return type_of(arguments[0], arguments[1:])
    if origin in {Union, UnionType}:
        return " | ".join(map(type_of, arguments))
    if origin is Literal:
        return f"Literal[{', '.join(map(json.dumps, arguments))}]"
    if origin is tuple and arguments[-1] is ...:
        return f"_Several[{type_of(arguments[0])}]"
    if origin is tuple:
        return f"tuple[{', '.join(map(type_of, arguments))}]"
    return {Path: "str | Path", type(None): "None"}.get(annotation) or str(annotation.__name__)


def keywords(options: type[Options]) -> Iterator[tuple[str, str]]:
    """Yield the keywords of an experiment with these options, each with its type."""
    for flag in distinct([*flags_of(options)]):
        if not flag.hidden:
            field = _field(options, flag.path)
            for name in dict.fromkeys((flag.path[-1], flag.key)):
                if name not in NOT_GIVEN:
                    yield name, type_of(field.annotation, field.metadata)


def _field(options: type[Options], path: Sequence[str]) -> FieldInfo:
    *groups, last = path
    for name in groups:
        options = group_of(options.model_fields[name]) or options
    return options.model_fields[last]


def stub() -> str:
    """Return the text of the file."""
    commands = sorted(name for name, each in EXPERIMENTS.loaded() if each.config.startswith("s2a_bench."))
    taken = {
        (name, mode.name): dict(keywords(mode.options)).items()
        for name in commands
        for mode in EXPERIMENTS[name].every_mode
    }
    sets: dict[tuple[Mode, ...], list[tuple[str, str]]] = defaultdict(list)
    for keyword in dict.fromkeys(chain(*taken.values())):
        sets[tuple(each for each in taken if keyword in taken[each])].append(keyword)
    shared = {modes: found for modes, found in sets.items() if len(modes) > 1 and len(found) >= TOGETHER}
    bases = {modes: f"_Shared{number}" for number, modes in enumerate(shared, 1)}
    parts = [HEAD, *(_class(bases[modes], ["TypedDict"], found) for modes, found in shared.items())]
    for each, found in taken.items():
        of_mode = [bases[modes] for modes in shared if each in modes]
        parts.append(_class(_named(*each), ["_Run", *of_mode], found - set(chain(*shared.values()))))
    return "\n".join([*parts, *map(_functions, commands)])


def _named(command: str, mode: str) -> str:
    return f"_{command.title()}{mode.title().replace('-', '')}"


def _class(name: str, bases: Iterable[str], found: Iterable[tuple[str, str]]) -> str:
    fields = "".join(f"    {name}: {kind}\n" for name, kind in sorted(found)) or "    pass\n"
    inside = f"{', '.join(bases)}, total=False"
    head = f"class {name}({inside}):\n"
    return (head if len(head) <= WIDTH else f"class {name}(\n    {inside}\n):\n") + fields


def _functions(command: str) -> str:
    """Return the signature of a command's function, one a mode: the first without ``mode``, too."""
    experiment, about = EXPERIMENTS[command], f'    """{EXPERIMENTS[command].about}"""\n'
    if not experiment.modes:
        return f"def {command}(**options: Unpack[{_named(command, '')}]) -> Run:\n{about}"
    signatures = []
    for place, mode in enumerate(experiment.every_mode):
        written = f'mode: Literal["{mode.name}"]{"" if place else " = ..."}'
        options = f"**options: Unpack[{_named(command, mode.name)}]"
        signatures.append(f"@overload\ndef {command}(*, {written}, {options}) -> Run:\n{about}")
    return "\n".join(signatures)


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
