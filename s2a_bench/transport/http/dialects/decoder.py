"""A sans-I/O decoder of all dialects: bytes of an answer in, events out.

It never raises, whatever a server sends: malformed bytes become an event with an error, and nothing follows an error.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from s2a_bench.errors import RequestFailed
from s2a_bench.secrets import struck
from s2a_bench.transport.http.dialects import Event
from s2a_bench.transport.http.dialects.common import Dialect
from s2a_bench.transport.http.dialects.framing import Framing

DONE = "[DONE]"
"""OpenAI's last message, which is not JSON."""

QUOTED = 120
"""Characters of a message that an error quotes."""

ODD = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, RecursionError)
"""Exceptions of reading a malformed message; JSON and Unicode errors are ValueErrors."""


class Decoder:
    def __init__(
        self, dialect: Dialect, loads: Callable[[Any], Any] = json.loads, framing: Callable[[], Framing] | None = None
    ) -> None:
        self._dialect = dialect
        self._loads = loads
        self._framing = (framing or dialect.framing)()
        self._failed = False

    def feed(self, data: bytes) -> Iterator[Event]:
        yield from self._events(self._framing.feed(data))

    def end(self) -> Iterator[Event]:
        yield from self._events(self._framing.end())

    def _events(self, messages: Iterator[str | bytes]) -> Iterator[Event]:
        if self._failed:
            return
        try:
            for message in messages:
                event = self._event(message)
                self._failed = bool(event.error)
                yield event
                if self._failed:
                    return
        except ValueError as error:  # a block is cut off
            self._failed = True
            yield Event(error=f"the server sent {error}")

    def _event(self, message: str | bytes) -> Event:
        if message == DONE:
            return Event(finish="done")
        try:
            value = self._loads(message)
            error = error_in(value)
            if error:
                return Event(error=f"the server broke off: {error}", status=status_in(value))
            event = self._dialect.event(value)
        except RequestFailed as problem:
            return Event(error=f"the server sent {problem}")
        except ODD as problem:
            text = message if isinstance(message, str) else message.decode("utf-8", "replace")
            start = struck(text)[:QUOTED].strip()  # struck first, because a cut could leave half a key
            return Event(error=f"this is not the dialect '{self._dialect.name}' ({problem!r}): {start}")
        return _storable(event)


def error_in(value: Any) -> str:
    """Return the message of a server's error object in any of its forms, or nothing.

    OpenAI, llama-server and Gemini send ``{"error": {"message": ...}}`` (Gemini at times in a list), Ollama and TGI
    ``{"error": "..."}``, vLLM until 0.10 ``{"object": "error", "message": ...}``, FastAPI ``{"detail": ...}``.
    """
    value = _first(value)
    error = value.get("error") or (value if value.get("object") == "error" else value.get("detail"))
    if isinstance(error, dict):
        error = error.get("message") or error
    return str(error) if error else ""


def _first(value: Any) -> dict[str, Any]:
    """Return an object, or the first in a list; an empty one for anything else."""
    value = value[0] if isinstance(value, list) and value else value
    return value if isinstance(value, dict) else {}


ERROR_TYPES = {"overloaded": 429, "validation": 422, "generation": 424, "incomplete_generation": 500}
"""TGI's ``error_type`` in a stream with status 200 -> the status of its other routes."""


def status_in(value: Any) -> int:
    """Return the HTTP status of an error object, 0 if it has none."""
    value = _first(value)
    error = value.get("error")
    code = error.get("code") if isinstance(error, dict) else value.get("code")
    if isinstance(code, int) and 400 <= code < 600:  # noqa: PLR2004 - HTTP's errors
        return code
    return ERROR_TYPES.get(str(value.get("error_type")).lower(), 0)


def _storable(event: Event) -> Event:
    """Replace lone surrogates, which JSON allows and no file can store."""
    if event.text is None or event.text.isascii():
        return event
    return replace(event, text=event.text.encode("utf-8", "replace").decode())
