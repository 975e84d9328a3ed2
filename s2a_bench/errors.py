"""Every error a user can meet, as one tree; the message names the field, path or key and the way out.

A field of a configuration stands in backquotes, as `runs`: the command line shows it as its flag, --runs.

S2AError
├── UsageError           a flag's value, or a combination of flags, makes no sense (exit code 2)
├── MissingExtra         a library that this needs is not installed
├── SourceError          a camera, video or image folder cannot deliver frames
├── EngineError          an engine cannot start or answer
│   ├── ModelError       a model file is missing, damaged or of the wrong kind
│   ├── BadRequest       no engine like this can answer this request: its grammar, its pictures, its length
│   └── Overdue          an answer takes longer than the server allows
├── TransportError       a request did not make its way
│   ├── RequestFailed    the server refused or broke off this one request; the next may succeed
│   │   ├── Busy         too many requests wait for the engine
│   │   └── MessagesLost the middleware lost messages of this request
│   ├── MissingInterface the ROS 2 workspace has not built a message's package, or another version of it
│   ├── PortInUse        a server cannot bind its address
│   └── ServerDied       the server's process is gone
├── SimulatorError       a simulator cannot start, or goes away
├── RobotError           a robot cannot be reached, or fails at an action
├── StoreError           a run folder cannot be written or read
└── UnlikeRuns           runs of other machines, models or settings, which are not to be compared
"""

from __future__ import annotations

from s2a_bench.secrets import struck
from s2a_bench.text import one_line


class S2AError(Exception):
    """Base of every expected failure: printed as one line, without a traceback."""

    exit_code = 1

    def __str__(self) -> str:
        """Return the message on one line that shows every letter, without secrets: servers word part of many."""
        return one_line(struck(super().__str__()))


class UsageError(S2AError):
    """A flag's value, or a combination of flags, makes no sense."""

    exit_code = 2


class MissingExtra(S2AError):
    """A library that this needs is not installed, or does not load."""


class SourceError(S2AError):
    """A camera, video or image folder cannot deliver frames."""


class EngineError(S2AError):
    """An engine cannot start or answer."""


class ModelError(EngineError):
    """A model file is missing, damaged or of the wrong kind."""


class BadRequest(EngineError):
    """No engine like this can answer this request: its grammar, its pictures, its length."""


class Overdue(EngineError):
    """An answer takes longer than the server allows."""


class TransportError(S2AError):
    """A request did not make its way to the server and back."""


class RequestFailed(TransportError):
    """The server refused or broke off this one request; the next may succeed, perhaps after ``retry_after_s``."""

    def __init__(self, message: str = "", *, retry_after_s: float | None = None) -> None:
        """Keep the message, and how long the server asked to wait, if it did."""
        super().__init__(message)
        self.retry_after_s = retry_after_s


class Busy(RequestFailed):
    """Too many requests wait for the engine."""


class MessagesLost(RequestFailed):
    """The middleware lost messages of this request."""


class MissingInterface(TransportError):
    """The ROS 2 workspace has not built a message's package, or another version of it."""


class PortInUse(TransportError):
    """A server cannot bind its address."""


class ServerDied(TransportError):
    """The server's process is gone."""


class SimulatorError(S2AError):
    """A simulator cannot start, or goes away."""


class RobotError(S2AError):
    """A robot cannot be reached, or fails at an action."""


class StoreError(S2AError):
    """A run folder cannot be written or read."""


class UnlikeRuns(S2AError):
    """Runs of other machines, models or settings, which are not to be compared."""
