"""The implementations of one kind by name, built in or offered by installed packages.

Built-ins are a table ``name -> "module:attribute"``; other packages add to a kind with entry points of the group
``s2a_bench.<kind>`` (Python packaging user guide, "entry points"). A look-up by name imports the module.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final, Generic, TypeVar

from s2a_bench.errors import UsageError
from s2a_bench.text import none_of

T = TypeVar("T")
OURS: Final = "s2a_bench."
_FUNCTION: Final = re.compile(r"[\w.]+:[\w.]+")
installed_points = cache(entry_points)  # each call reads the metadata of all packages


class Registry(Mapping[str, T], Generic[T]):
    """The implementations of one kind by name; iterating gives the names, built-ins first."""

    def __init__(self, kind: str, field: str, builtins: Mapping[str, str]) -> None:
        """Offer ``builtins`` and the entry points of ``s2a_bench.<kind>``; ``field`` is where users write the name."""
        self.group = f"s2a_bench.{kind}"
        self.field = field
        self._builtins = dict(builtins)

    @cached_property
    def _offered(self) -> dict[str, EntryPoint]:
        """Return the entry points of installed packages, except those with a built-in's name.

        Of two with one name it is that of s2a-bench, else the first by module, wherever they are installed.
        """
        offered = installed_points().select(group=self.group)
        points = sorted(offered, key=lambda each: (not each.value.startswith(OURS), each.value))
        by_name = {point.name: point for point in reversed(points)}
        return {name: point for name, point in sorted(by_name.items()) if name not in self._builtins}

    def __getitem__(self, name: str) -> T:
        """Load an implementation; raises UsageError for an unknown name, and for a package that does not load."""
        if name in self._builtins:
            built_in: T = resolve_name(self._builtins[name])
            return built_in
        if name not in self._offered:
            unknown = none_of(name, self, f" (packages add to them as '{self.group}')")
            raise UsageError(f"`{self.field}`: {unknown}")
        point = self._offered[name]
        try:
            offered: T = point.load()
        except Exception as error:  # a package may raise anything while it is imported
            package = point.dist.name if point.dist else point.value
            raise UsageError(
                f"`{self.field}`: '{name}' of the package {package} does not load: {type(error).__name__}: {error}"
            ) from error
        return offered

    def __contains__(self, name: object) -> bool:
        return name in self._builtins or name in self._offered

    def __iter__(self) -> Iterator[str]:
        yield from self._builtins
        yield from self._offered

    def __len__(self) -> int:
        return len(self._builtins) + len(self._offered)

    def built_in(self) -> tuple[str, ...]:
        return tuple(self._builtins)

    def loaded(self) -> Iterator[tuple[str, T]]:
        """Yield every name with its implementation: built-ins, then those of packages that load, by any ``order``."""
        yield from ((name, self[name]) for name in self._builtins)
        offered = list[tuple[str, T]]()
        for name in self._offered:
            with suppress(UsageError):
                offered.append((name, self[name]))
        yield from sorted(offered, key=lambda each: getattr(each[1], "order", 0))


def check_function(written: str) -> None:
    """Raise UsageError, for a parameter ``function``, unless it is written ``module:name``."""
    if not _FUNCTION.fullmatch(written):
        raise UsageError(f"function = '{written}' should look like module:name")


def function_of(written: str, what: str) -> Callable[..., Any]:
    """Import a user's function, written ``module:name``; raises UsageError, which begins with ``what``."""
    try:
        function: object = resolve_name(written)
    except Exception as error:  # a module may raise anything while it is imported
        raise UsageError(
            f"{what}: {written} does not load: {type(error).__name__}: {error}; is its folder in PYTHONPATH?"
        ) from error
    if not callable(function):
        raise UsageError(f"{what}: {written} cannot be called: it is of type {type(function).__name__}")
    return function


def missing_entry_points(checkout: Path = Path(__file__).parent.parent) -> list[str]:
    """Return the plug-ins of a checkout that its installed metadata lacks or has elsewhere, as it is older; else []."""
    if not (project := checkout / "pyproject.toml").is_file():
        return []
    tomllib = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    about = tomllib.loads(project.read_text(encoding="utf-8")).get("project", {})
    declared = about["entry-points"] if about.get("name") == "s2a-bench" else {}  # or we lie in another's folder
    try:
        installed = {(point.group, point.name, point.value) for point in distribution("s2a-bench").entry_points}
    except PackageNotFoundError:
        installed = set()
    missing = (
        name for group, points in declared.items() for name, at in points.items() if (group, name, at) not in installed
    )
    return [*dict.fromkeys(missing)]
