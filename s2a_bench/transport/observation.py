"""Observation templates: a TOML or JSON file that says what a foreign policy is told, with places for what varies.

It describes the nested dictionary that the policy wants. These texts in it are places:

- ``"{image}"``, ``"{image:1}"``: the first, the second picture, uint8 (H, W, 3) RGB. ``"{image:0|CHW}"`` is
  (3, H, W) of it, ``"{image:0|bytes}"`` its file as bytes, where pictures travel as JPEG or PNG.
- ``"{state}"``, ``"{state:0:7}"``, ``"{state:7:}"``: the robot's state, float32 (D,), or some of it.
- ``{prompt}``, also within a text: ``"Task: {prompt}"``. A brace that is none of these is written twice.

A list of arrays becomes one array with one more axis in front: ``[["{image}"]]`` is (1, 1, H, W, 3) and
``["{image:0}", "{image:1}"]`` is (2, H, W, 3), while ``[["{prompt}"]]`` stays a list of lists of text. A key that ends
with ``?`` is left out, without the mark, where the request lacks a picture or the numbers that its value wants. All
else stands for itself. The files beside this module, in ``templates``, are known by name.

`PolicyTransport` is what transports to servers that are told by such a template have in common.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, NoReturn, TypeAlias, TypeVar

import numpy as np
from pydantic import AfterValidator

from s2a_bench import extras, toml_file
from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.text import none_of, read_text
from s2a_bench.transport import ACTIONS, Capabilities, Choice, Transport
from s2a_bench.transport.listening import ListeningOptions, read_key
from s2a_bench.types import Pixels, Vector

HERE: Final = Path(__file__).with_name("templates")
DEFAULT: Final = "openpi"
FILE_LETTERS, VALUES, DEPTH, CAMERAS = 1 << 16, 1024, 16, 64
"""The most that a template has: bytes, values, dictionaries and lists within each other, pictures."""
STATE: Final = 10**6
"""More numbers than a place for the state can want."""
WHOLE: Final = range(-(1 << 63), 1 << 64)
"""What MessagePack has room for."""

_PLACE = re.compile(
    r"\{(?:(?P<picture>image)(?::(?P<image>\d{1,3}))?(?:\|(?P<form>\w+))?"
    r"|state(?::(?P<start>\d{0,6}):(?P<stop>\d{0,6}))?)\}"
)
_IN_TEXT = re.compile(r"\{\{|\}\}|\{prompt\}|[{}]")
_BRACES = {"{{": "{", "}}": "}"}
_FORMS = (None, "CHW", "bytes")


class _Missing(Exception):
    """What a place wants is not in the request."""


@dataclass(frozen=True, slots=True)
class _Given:
    pictures: Sequence[Pixels]
    state: Vector
    prompt: str


_Make: TypeAlias = Callable[[_Given], Any]


class Template:
    """What one policy is told."""

    def __init__(self, content: Any, name: str) -> None:
        """Read a template that TOML or JSON was; raises UsageError naming the key that makes no sense."""
        self.name = name
        self.pictures = 0
        """How many pictures it has places for."""
        self.accepts_state = False
        self.encoded = False
        """Whether pictures are the bytes of a file, as JPEG."""
        self._values = 0
        if not isinstance(content, Mapping):
            raise UsageError(f"`template` {name} should be a table of keys, not {type(content).__name__}")
        self._make = self._table(content, "", 0)

    def fill(self, pictures: Sequence[Pixels], state: Sequence[float], prompt: str) -> dict[str, Any]:
        """Return the observation: its arrays are those of ``pictures``, uint8 (H, W, 3) or (n,), as far as can be.

        Raises RequestFailed naming the key whose picture or state is missing, or what has no place.
        """
        if len(pictures) > self.pictures:
            raise RequestFailed(f"`template` {self.name} has places for {self.pictures} pictures, not {len(pictures)}")
        if len(state) and not self.accepts_state:
            raise RequestFailed(f"`template` {self.name} has no place for the robot's state")
        try:
            filled: dict[str, Any] = self._make(_Given(pictures, np.asarray(state, np.float32), prompt))
        except _Missing as missing:
            raise RequestFailed(f"`template` {self.name}: {missing}") from None
        return filled

    def check_pictures(self, cameras: int) -> None:
        """Raise UsageError where it has places for fewer pictures, or wants more."""
        why = f"has places for {self.pictures}" if cameras > self.pictures else ""
        try:
            self._make(_Given([np.zeros((1, 1, 3), np.uint8)] * cameras, np.zeros(STATE, np.float32), ""))
        except _Missing:
            why = f"wants {self.pictures}"
        if why:
            other = f"use `cameras` {self.pictures}, or another template" if self.pictures else "use another template"
            raise UsageError(f"`cameras`: {cameras} a request, and `template` {self.name} {why}; {other}")

    def _refuse(self, path: str, why: str) -> NoReturn:
        raise UsageError(f"`template` {self.name}: {path or 'it'} {why}")

    def _value(self, value: Any, path: str, depth: int) -> _Make:
        """Prepare a value of any kind."""
        self._values += 1
        if depth > DEPTH or self._values > VALUES:
            self._refuse(path, f"is beyond what is read: {VALUES} values, {DEPTH} within each other")
        if isinstance(value, Mapping):
            return self._table(value, path, depth)
        if isinstance(value, list):
            return self._list(value, path, depth)
        if isinstance(value, str):
            return self._text(value, path)
        if not (value is None or isinstance(value, (bool, float)) or (isinstance(value, int) and value in WHOLE)):
            self._refuse(path, f"is {value!r}, which no policy can be told")
        return lambda _: value

    def _table(self, table: Mapping[str, Any], path: str, depth: int) -> _Make:
        made: dict[str, tuple[_Make, bool]] = {}
        for key, value in table.items():
            name = key.removesuffix("?")
            here = f"{path}.{name}" if path else name
            if not name or name in made or not _is_text(name):
                self._refuse(here, "is twice there, empty, or no Unicode text")
            made[name] = self._value(value, here, depth + 1), name != key

        def make(given: _Given) -> dict[str, Any]:
            filled = {}
            for name, (value, optional) in made.items():
                try:
                    filled[name] = value(given)
                except _Missing:
                    if not optional:
                        raise
            return filled

        return make

    def _list(self, values: Sequence[Any], path: str, depth: int) -> _Make:
        makes = [self._value(value, f"{path}[{index}]", depth + 1) for index, value in enumerate(values)]

        def make(given: _Given) -> Any:
            filled = [make(given) for make in makes]
            if not filled or not all(isinstance(each, np.ndarray) for each in filled):
                return filled
            if len(filled) == 1:
                return filled[0][np.newaxis]  # without a copy
            try:
                return np.stack(filled)
            except ValueError as error:
                raise RequestFailed(f"`template` {self.name}: {path}: {error}") from None

        return make

    def _text(self, text: str, path: str) -> _Make:
        if not _is_text(text):
            self._refuse(path, "is no Unicode text")
        if place := _PLACE.fullmatch(text):
            if place["picture"]:
                return self._picture(path, int(place["image"] or 0), place["form"])
            return self._state(path, place["start"] or "", place["stop"] or "")
        for brace in _IN_TEXT.finditer(text):
            if brace[0] in {"{", "}"}:
                places = "{image}, {image:1}, {image:0|CHW}, {state}, {state:0:7}, {prompt}"
                self._refuse(path, f"has a brace that is no place: {text!r}; there are {places}, and {{{{ for a brace")
        return lambda given: _IN_TEXT.sub(lambda found: _BRACES.get(found[0], given.prompt), text)

    def _picture(self, path: str, index: int, form: str | None) -> _Make:
        if index >= CAMERAS or form not in _FORMS:
            self._refuse(path, f"wants picture {index} as {form}; there are up to {CAMERAS}, as CHW or bytes")
        self.pictures = max(self.pictures, index + 1)
        self.encoded |= form == "bytes"

        def make(given: _Given) -> Any:
            if index >= len(given.pictures):
                raise _Missing(f"{path} wants picture {index}, and the request has {len(given.pictures)}")
            picture = given.pictures[index]
            if form is None:
                return picture
            return picture.tobytes() if form == "bytes" else np.ascontiguousarray(np.moveaxis(picture, -1, 0))

        return make

    def _state(self, path: str, start: str, stop: str) -> _Make:
        first, last = int(start or 0), int(stop) if stop else None
        if last is not None and last <= first:
            self._refuse(path, f"wants the numbers {first}:{last} of the state, which are none")
        self.accepts_state = True

        def make(given: _Given) -> Vector:
            if len(given.state) < (last or first + 1):
                wanted = f"{first}:{last or ''}" if first or last else "all"
                raise _Missing(f"{path} wants the state's numbers ({wanted}), and the request has {len(given.state)}")
            return given.state[first:last]

        return make


def names() -> list[str]:
    """Return the templates that are known by name."""
    return sorted(path.stem for path in HERE.glob("*.toml"))


def template_of(told: str) -> Template:
    """Return the template of a name, or of a TOML or JSON file; raises UsageError."""
    known = names()
    if told in known:
        return Template(toml_file.loads((HERE / f"{told}.toml").read_text("utf-8"), told), told)
    path = Path(told)
    if not path.suffix:
        raise UsageError(f"`template`: {none_of(told, known, ', nor a TOML or JSON file')}")
    try:
        text = read_text(path, FILE_LETTERS)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise UsageError(f"`template`: cannot read {told}: {error}") from error
    return Template(_loads(text, told) if path.suffix == ".json" else toml_file.loads(text, told), told)


def _loads(text: str, where: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_table)
    except RecursionError:
        raise UsageError(f"`template` {where}: its lists or objects are too deep") from None
    except ValueError as error:
        raise UsageError(f"`template` {where}: no JSON: {error}") from error


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key is twice there")
    return table


def _is_text(text: str) -> bool:
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


def _readable(told: str) -> str:
    try:
        template_of(told)
    except UsageError as error:
        raise ValueError(str(error).removeprefix("`template`").lstrip(": ")) from None
    return told


TemplateName = Annotated[str, AfterValidator(_readable)]
"""Name or path of a template that can be read."""


class PolicyOptions(ListeningOptions):
    """How a policy server is reached, and what it is told."""

    @property
    def template_name(self) -> str:
        """Return the name or the path of the template."""
        raise NotImplementedError


P = TypeVar("P", bound=PolicyOptions)


class PolicyTransport(Transport[P]):
    """Observations go up as MessagePack, a chunk of actions comes back."""

    payloads: ClassVar[tuple[str, ...]] = ("raw", "jpeg", "jpeg-preencoded", "png")
    answer_kinds = (ACTIONS,)
    stages: ClassVar[Mapping[str, str]] = {"msgpack_pack": "pack", "msgpack_parse": "parse"}
    modules: ClassVar[tuple[str, ...]]
    """What the extra of its name brings, by the names under which they are imported."""

    def capabilities(self, choice: Choice[P]) -> Capabilities[P]:
        """Return what a policy takes: pixels, unless its template says that it decodes files."""
        options, template = choice.options, template_of(choice.options.template_name)
        pixels = self.payloads[:1] if options.url else self.payloads
        payloads = self.payloads[1:] if template.encoded else pixels
        return Capabilities(options, payloads, self.answer_kinds, template.accepts_state, self.facts)

    def require(self, choice: Choice[P]) -> None:
        """Refuse a key that is not there, and a template for other pictures; raises MissingExtra too."""
        extras.need(self.name, *self.modules)
        template_of(choice.options.template_name).check_pictures(choice.cameras)
        read_key(choice.options.api_key_env)
