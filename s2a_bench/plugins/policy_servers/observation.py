"""Observation templates: a TOML or JSON file that describes the observation of a policy server, with placeholders.

It holds the nested dictionary that the policy expects; docs/policy-servers.md lists the texts in it that are
placeholders. Pictures are uint8 (H, W, 3) RGB, the state is float32 (D,). A list of arrays becomes one array with one
more axis in front: ``["{image:0}", "{image:1}"]`` is (2, H, W, 3), while ``[["{prompt}"]]`` stays a list of lists of
text. The table `EXTENSION` is not part of the observation: it describes the server, as `ExternalServer` reads it. The
files in ``templates`` beside this module are known by name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn, TypeAlias
from uuid import uuid4

import numpy as np
from pydantic import AfterValidator, Field

from s2a_bench import toml_file
from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.text import none_of
from s2a_bench.types import Pixels, Vector

TEMPLATES: Final = Path(__file__).with_name("templates")
DEFAULT: Final = "openpi"
EXTENSION: Final = "s2a"
"""Key that no observation has."""
ANY: Final = "*"
"""End of a key whose pictures have names from the server's greeting."""
CAMERAS: Final = 64
"""The most pictures of a template."""
PICTURE_ROOTS: Final = "", "images.", "observation.images.", "input.images.", "input.observation.images."
"""Prefixes of the names of pictures that a server lists (SGLang)."""

_PLACE = re.compile(
    r"\{(?:(?P<all>images)|(?P<picture>image)(?::(?P<image>\d{1,3}))?(?:\|(?P<form>\w+))?"
    r"|state(?::(?P<start>\d{0,6}):(?P<stop>\d{0,6}))?)\}"
)
_IN_TEXT = re.compile(r"\{\{|\}\}|\{prompt\}|\{session\}|[{}]")
_BRACES = {"{{": "{", "}}": "}"}


class _Missing(RequestFailed):
    """The request lacks the value of a placeholder."""


@dataclass(frozen=True, slots=True)
class _Values:
    pictures: Sequence[Pixels]
    state: Vector
    prompt: str
    names: Sequence[str]


_Make: TypeAlias = Callable[[_Values], Any]


class ExternalServer(toml_file.TomlTable):
    """The differences of a policy server from openpi's: the table `EXTENSION` of a template."""

    path: Annotated[str, Field(max_length=200, pattern=r"^(/[\w.~/-]*)?$")] = ""
    """Path of its address, where `url` has none."""
    greets: bool = True
    """Whether the first message of a connection is its description."""
    text_keys: bool = False
    """Whether the keys of an array's map are texts, not bytes."""
    arrays_as_text: bool = False
    """Whether each array is a text that is JSON, within the JSON of the observation."""
    arrays_as_lists: bool = False
    """Whether each array is a list of lists of numbers in the JSON of the observation."""
    image_maps: bool = False
    """Whether an encoded picture is a map, as vla-eval has it."""
    answer: Annotated[str, Field(max_length=200)] = "actions"
    """Keys, and places in lists, that lead to the actions of an answer, joined by dots; empty if it is the actions."""
    reset: dict[str, Any] | None = None
    """Message that begins a session: sent on each connection before the first observation, and answered by one."""
    idle_s: Annotated[float, Field(ge=1, le=3600)] | None = None
    """Silence after which it closes a connection, in seconds; it skips an empty message, which ends a silence."""

    def actions_in(self, answer: Any) -> Any:
        """Return the actions of an answer, as the server has them; raises RequestFailed for an answer without."""
        value = answer
        for key in filter(None, self.answer.split(".")):
            try:
                value = value[int(key) if isinstance(value, list) else key]
            except (LookupError, TypeError, ValueError):
                raise RequestFailed(f"an answer without {self.answer}: {_keys(value)}") from None
        return value


class Template:
    def __init__(self, content: Any, name: str) -> None:
        self.name = name
        self._session = uuid4().hex
        self.pictures = 0
        """Number of pictures that it has placeholders for."""
        self._keys: list[tuple[int, str]] = []
        self.unnamed = False
        """Whether the server's greeting names the pictures."""
        self.accepts_state = False
        self.encoded = False
        """Whether pictures are the bytes of a file, as JPEG."""
        if not isinstance(content, Mapping):
            raise UsageError(f"`template` {name} should be a table of keys, not {type(content).__name__}")
        server = content.get(EXTENSION, {})
        self.server = toml_file.checked(ExternalServer, server, f"`template` {name}: {EXTENSION}")
        self._make = self._table({key: value for key, value in content.items() if key != EXTENSION}, "")

    def fill(
        self, pictures: Sequence[Pixels], state: Sequence[float], prompt: str, names: Sequence[str] = ()
    ) -> dict[str, Any]:
        """Return the observation, if possible without copies of ``pictures``, uint8 (H, W, 3) or (n,).

        ``names`` are those of the pictures that the server reads, in its order. Raises RequestFailed for a key without
        its picture or state, and for a value without a placeholder.
        """
        if len(pictures) > self.pictures:
            raise RequestFailed(f"`template` {self.name} has places for {self.pictures} pictures, not {len(pictures)}")
        if len(state) and not self.accepts_state:
            raise RequestFailed(f"`template` {self.name} has no place for the robot's state")
        filled: dict[str, Any] = self._make(_Values(pictures, np.asarray(state, np.float32), prompt, names))
        return filled

    def check_request(self, cameras: int, state: int) -> dict[str, Any]:
        """Return the observation of a request with so many pictures, and numbers of the state; raises UsageError."""
        try:
            return self.fill([np.zeros((1, 1, 3), np.uint8)] * cameras, [0.0] * state, "")
        except RequestFailed as error:
            raise UsageError(f"{error}; see `cameras` and `state`") from error

    def ignored(self, listed: Sequence[str]) -> list[tuple[int, str]]:
        """Return place and key of each picture that a server which reads the pictures ``listed`` ignores."""
        read = {root + key for root in PICTURE_ROOTS for key in listed}
        return [(index, path) for index, path in self._keys if path not in read and not path.endswith(ANY)]

    def check_server(self, transport: str, reads: Sequence[str]) -> None:
        """Refuse a description of the server of which ``transport`` does not read all, only the keys ``reads``."""
        if self.unnamed and "greets" not in reads:
            raise UsageError(f"`template` {self.name}: {transport} has no greeting that names pictures; name them")
        if unread := [f"{EXTENSION}.{key}" for key in self.server.model_fields_set if key not in reads]:
            raise UsageError(f"`template` {self.name}: {transport} does not read {min(unread)}; leave it out")

    def _refuse(self, path: str, why: str) -> NoReturn:
        raise UsageError(f"`template` {self.name}: {path or 'it'} {why}")

    def _missing(self, path: str, wanted: str, present: object) -> _Missing:
        return _Missing(f"`template` {self.name}: {path} wants {wanted}, and the request has {present}")

    def _value(self, value: Any, path: str) -> _Make:
        if isinstance(value, Mapping):
            return self._table(value, path)
        if isinstance(value, list):
            return self._list(value, path)
        if isinstance(value, str):
            return self._text(value, path)
        if not (value is None or isinstance(value, (bool, int, float))):
            self._refuse(path, f"is {value!r}, which no observation can hold")
        return lambda _: value

    def _table(self, table: Mapping[str, Any], path: str) -> _Make:
        makers: dict[str, tuple[_Make, bool]] = {}
        for key, value in table.items():
            name = key.removesuffix("?")
            inner = f"{path}.{name}" if path else name
            if not name or name in makers:
                self._refuse(inner, "is twice there, or empty")
            makers[name] = self._value(value, inner), name != key

        def make(values: _Values) -> dict[str, Any]:
            filled: dict[str, Any] = {}
            for name, (value, optional) in makers.items():
                try:
                    filled |= _keyed(name, value(values), values.names)
                except _Missing:
                    if not optional:
                        raise
            return filled

        return make

    def _list(self, values: Sequence[Any], path: str) -> _Make:
        makes = [self._value(value, f"{path}[{index}]") for index, value in enumerate(values)]

        def make(values: _Values) -> Any:
            filled = [make(values) for make in makes]
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
        if place := _PLACE.fullmatch(text):
            if place["all"]:
                return self._pictures(path)
            if place["picture"]:
                return self._picture(path, int(place["image"] or 0), place["form"])
            return self._state(path, place["start"] or "", place["stop"] or "")
        for brace in _IN_TEXT.finditer(text):
            if brace[0] in {"{", "}"}:
                places = "{image}, {image:1}, {image:0|CHW}, {images}, {state}, {state:0:7}, {prompt}, {session}"
                self._refuse(path, f"has an unknown place: {text!r}; there are {places}, and {{{{ for a brace")
        texts = {**_BRACES, "{session}": self._session}
        return lambda values: _IN_TEXT.sub(lambda brace: texts.get(brace[0], values.prompt), text)

    def _pictures(self, path: str) -> _Make:
        self.pictures = CAMERAS
        self.unnamed |= path.endswith(ANY)
        self._keys.append((0, path))

        def make(values: _Values) -> list[Pixels]:
            if not values.pictures:
                raise self._missing(path, "pictures", "none")
            return list(values.pictures)

        return make

    def _picture(self, path: str, index: int, form: str | None) -> _Make:
        if index >= CAMERAS or form not in {None, "CHW", "bytes"}:
            self._refuse(path, f"wants picture {index} as {form}; there are up to {CAMERAS}, as CHW or bytes")
        if form and self.server.image_maps:
            self._refuse(path, f"wants {form}, and {EXTENSION}.image_maps has pictures as maps; leave one out")
        self.pictures = max(self.pictures, index + 1)
        self.encoded |= form == "bytes"
        self._keys.append((index, path))

        def make(values: _Values) -> Any:
            if index >= len(values.pictures):
                raise self._missing(path, f"{index + 1} pictures", len(values.pictures))
            picture = values.pictures[index]
            if form is None:
                return picture
            return picture.tobytes() if form == "bytes" else np.ascontiguousarray(np.moveaxis(picture, -1, 0))

        return make

    def _state(self, path: str, start: str, stop: str) -> _Make:
        first, last = int(start or 0), int(stop) if stop else None
        if last is not None and last <= first:
            self._refuse(path, f"wants the numbers {first}:{last} of the state: an empty range")
        self.accepts_state = True

        def make(values: _Values) -> Vector:
            if len(values.state) < (last or first + 1):
                wanted = f"{first}:{last or ''}" if first or last else "all"
                raise self._missing(path, f"the state's numbers ({wanted})", len(values.state))
            return values.state[first:last]

        return make


def names() -> list[str]:
    return sorted(path.stem for path in TEMPLATES.glob("*.toml"))


def template_of(name: str) -> Template:
    """Return the template of a name, or of a TOML or JSON file; raises UsageError."""
    built_in = names()
    path = TEMPLATES / f"{name}.toml" if name in built_in else Path(name)
    if not path.suffix:
        raise UsageError(f"`template`: {none_of(name, built_in, ', nor a TOML or JSON file')}")
    text = toml_file.read(path, "template")
    try:
        return Template(_loads(text, name) if path.suffix == ".json" else toml_file.loads(text, name), name)
    except RecursionError:
        raise UsageError(f"`template` {name}: its lists or objects are too deep") from None


def _loads(text: str, name: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_table)
    except ValueError as error:
        raise UsageError(f"`template` {name}: not JSON: {error}") from error


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key is twice there")
    return table


def _keys(answer: Any) -> str:
    keys = ", ".join(str(key)[:40] for key in list(answer)[:8]) if isinstance(answer, dict) else type(answer).__name__
    return keys or "nothing"


def _keyed(name: str, value: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return a value by its key, or pictures by the ``names`` that the server has for them."""
    if not (names and name.endswith(ANY)):
        return {name: value}
    if len(value) > len(names):
        wanted = f"{len(names)} pictures ({', '.join(names)})"
        raise RequestFailed(f"the server reads {wanted}, not {len(value)}; see `cameras`")
    return {name.removesuffix(ANY) + key: picture for key, picture in zip(names, value, strict=False)}


def _readable(name: str) -> str:
    try:
        template_of(name or DEFAULT)
    except UsageError as error:
        raise ValueError(str(error).removeprefix("`template`").lstrip(": ")) from None
    return name


TemplateName = Annotated[str, AfterValidator(_readable)]
"""Name or path of a readable template, empty for the transport's own."""
