"""All errors of the package, as one tree; the message names the field, path or key and the way out. And exit codes.

A field of a configuration is in backquotes, as `requests`: the command line shows it as its flag, --requests.

::

    S2AError
    ├── UsageError, MissingExtra, SourceError, RobotError, SimulatorError, StoreError, UnlikeRuns, NotPermitted
    ├── EngineError: ModelError, BadRequest, Overdue
    └── TransportError: MissingInterface, PortInUse, ServerDied, ClockMoved
        └── RequestFailed: Busy, TooLarge, MessagesLost
"""

from __future__ import annotations

from signal import SIGILL

from s2a_bench.secrets import struck
from s2a_bench.text import one_line

TRIPPED = 3
"""Exit code of `compare` if a gate trips."""
UNDECIDED = 4
"""Exit code of `compare` if no gate trips and one could not have detected a change of the size of its limit."""

SETUP_AGAIN = "run `make setup` again"
COMPILE_AGAIN = "compile it on this machine"
"""The way out for a user's program."""


class S2AError(Exception):
    """Base of every expected failure: printed as one line, without a traceback."""

    exit_code = 1

    def __str__(self) -> str:
        """Return the message on one line, every letter visible, without secrets: servers write part of many."""
        return one_line(struck(super().__str__()))


class UsageError(S2AError):
    """A flag's value, or a combination of flags, makes no sense."""

    exit_code = 2


class MissingExtra(S2AError):
    """A required library is not installed, or does not load."""


class SourceError(S2AError):
    """A camera, video or image folder cannot deliver frames."""


class EngineError(S2AError):
    """An engine cannot start or answer."""


class ModelError(EngineError):
    """A model file is missing, damaged or of the wrong kind."""


class BadRequest(EngineError):
    """The engine cannot answer this request: its grammar, its pictures, its length."""


class Overdue(EngineError):
    """An answer takes longer than the server allows."""


class TransportError(S2AError):
    """A request failed between client and server."""

    starting = False
    """Whether the server may only be starting, so that it is worth waiting for."""


class ClockMoved(TransportError):
    """The clocks of two hosts cannot be joined: one was stepped or slewed."""


class RequestFailed(TransportError):
    """The server refused or cancelled this request; the next may succeed, perhaps after ``retry_after_s``."""

    def __init__(self, message: str = "", *, retry_after_s: float | None = None, starting: bool = False) -> None:
        super().__init__(message)
        self.retry_after_s, self.starting = retry_after_s, starting


class Busy(RequestFailed):
    """Too many requests wait for the engine."""


class TooLarge(RequestFailed):
    """The request is larger than the server's limit."""


class MessagesLost(RequestFailed):
    """The middleware lost messages of this request."""


class MissingInterface(TransportError):
    """The ROS 2 workspace lacks a message's package, or has another version of it."""


class PortInUse(TransportError):
    """A server cannot bind its address."""


class ServerDied(TransportError):
    """The server's process has ended, or nothing answers at its address."""

    starting = True


class RobotError(S2AError):
    """A robot cannot be reached, or fails at an action."""


class SimulatorError(S2AError):
    """A simulator's server cannot be reached, or fails at a step."""


class StoreError(S2AError):
    """A run folder cannot be written or read."""


class UnlikeRuns(S2AError):
    """Runs of different machines, models or settings, which must not be compared."""


class NotPermitted(S2AError):
    """This process may not create network namespaces."""


def how_it_ended(code: int | None, cure: str = SETUP_AGAIN) -> str:
    """Describe a `returncode` of `subprocess`, an illegal instruction with its cause and ``cure``."""
    if code is None or code >= 0:
        return f"exit code {code}"
    if -code != SIGILL:
        return f"killed by signal {-code}"
    return (
        f"killed by signal {-code} (SIGILL): llama.cpp was compiled for another processor, or by a compiler whose "
        f"code for AMX does not work; {cure}"
    )
