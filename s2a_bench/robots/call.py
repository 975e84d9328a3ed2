"""A robot that is a Python function of its user's: called with each action, and not at all in a stall."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar, Final

from s2a_bench.errors import RobotError, UsageError

if TYPE_CHECKING:
    from s2a_bench.types import Vector

_FUNCTION: Final = re.compile(r"[\w.]+:[\w.]+")


@dataclass(frozen=True, slots=True)
class Call:
    """Call ``function``, written ``module:name``, with each action, float32 (D,); what it returns is not looked at.

    It runs on the control loop's thread: while it does, nothing else is executed.
    """

    name: ClassVar[str] = "call"

    function: str = ""

    def __post_init__(self) -> None:
        """Refuse what names no function."""
        if not _FUNCTION.fullmatch(self.function):
            raise UsageError(f"function = '{self.function}' should look like module:name")

    def open(self, dims: int, period_ns: int) -> CallRobot:
        """Import the function; raises UsageError where that fails."""
        del dims, period_ns  # the function's own business
        try:
            function = resolve_name(self.function)
        except Exception as error:  # a module may raise anything while it is imported
            raise UsageError(
                f"`robot`: call: {self.function} does not load: {type(error).__name__}: {error}; "
                "is its folder in PYTHONPATH?"
            ) from error
        if not callable(function):
            raise UsageError(
                f"`robot`: call: {self.function} cannot be called: it is of type {type(function).__name__}"
            )
        return CallRobot(self.function, function)


class CallRobot:
    """Calls a function."""

    def __init__(self, name: str, function: Callable[[Vector], object]) -> None:
        """Take the function, and its name for errors."""
        self._name, self._function = name, function

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Call the function; raises RobotError for what it raises."""
        del at_ns
        if action is None:
            return
        try:
            self._function(action)
        except Exception as error:
            raise RobotError(f"`robot`: call: {self._name}: {type(error).__name__}: {error}") from error

    def state(self) -> tuple[float, ...]:
        """Return nothing: the function does not say."""
        return ()

    def describe(self) -> dict[str, str]:
        """Return which function."""
        return {"robot": "call", "function": self._name}

    def close(self) -> None:
        """Do nothing."""
