"""What HTTP servers speak: one adapter a dialect, without any I/O, built in or offered by a package.

An adapter builds a request's body and says what one message of the answer means. Cutting the bytes into messages is
the `Decoder`'s; sending, marking stages and telling errors are the client's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from s2a_bench.facts import Fact
from s2a_bench.registry import Registry
from s2a_bench.trace import Remote, Trace
from s2a_bench.types import Action, Frame, Pixels, Request

OWN = "s2a"
"""The dialect of our own server, in all its variants."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture that is ready to be packed; ``shape`` is that of the bytes: (n,) or (height, width, 3)."""

    media_type: str
    base64: str
    shape: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Event:
    """What one message of an answer says; a field at its default says nothing.

    ``text`` is a piece of the answer itself, ``thinking`` what a model says to itself before, ``finish`` why the
    answer is complete, ``error`` that it will never be.
    """

    text: str | None = None
    token_id: int = -1
    thinking: str = ""
    finish: str = ""
    facts: dict[str, float] = field(default_factory=dict)
    remote: Remote | None = None
    error: str = ""
    actions: Sequence[Action] = ()
    """Pieces of a policy's answer, which has no text."""
    status: int = 0
    """The HTTP status that the error would have had before the stream began, 0 if unknown."""


class Framing(Protocol):
    """How messages are cut out of a body."""

    def feed(self, data: bytes) -> Iterator[str | bytes]:
        """Yield the messages that these bytes complete; raises ValueError for one that is too large."""
        ...

    def end(self) -> Iterator[str | bytes]:
        """Yield what is left when the body has ended."""
        ...


class Dialect(Protocol):
    """One dialect: pure, without state."""

    name: str
    media_type: str
    """What a good answer's content-type starts with."""
    payloads: tuple[str, ...]
    """How pictures can travel."""
    framing: Callable[[], Framing]
    tells: Sequence[Fact]
    """The facts of its events."""

    def met(self, base: str, model: str, get: Callable[[str], Any]) -> tuple[str, str]:
        """Return the URL and the model to ask: as told, else as the server says; ``get`` returns the JSON at a URL."""
        ...

    def url(self, base: str, model: str) -> str:
        """Return where to post, for the URL that a user gave."""
        ...

    def authorization(self, key: str) -> dict[str, str]:
        """Return the headers that carry an API key."""
        ...

    def encode(self, frame: Frame, payload: str, trace: Trace) -> tuple[str, Pixels]:
        """Return the media type and the bytes of a picture, marking each stage."""
        ...

    def body(self, request: Request, pictures: list[Picture], model: str) -> dict[str, Any]:
        """Return the request's body; raises UsageError for what the dialect cannot say."""
        ...

    def event(self, message: Any) -> Event:
        """Return what one message means; whatever it raises for a message of another form is the Decoder's to catch."""
        ...

    def starts_with_headers(self, facts: dict[str, float]) -> bool:
        """Return whether the response's headers are known to have left when inference started."""
        ...


DIALECTS: Final[Registry[Callable[[], Dialect]]] = Registry(
    "dialects",
    "dialect",
    {
        OWN: "s2a_bench.transport.http.dialects.openai:Own",
        "openai": "s2a_bench.transport.http.dialects.openai:OpenAI",
        "llama-server": "s2a_bench.transport.http.dialects.openai:LlamaServer",
        "vllm": "s2a_bench.transport.http.dialects.openai:Vllm",
        "ollama": "s2a_bench.transport.http.dialects.ollama:Ollama",
        "tgi": "s2a_bench.transport.http.dialects.tgi:Tgi",
        "gemini": "s2a_bench.transport.http.dialects.gemini:Gemini",
        "openvla": "s2a_bench.transport.http.dialects.openvla:OpenVla",
    },
)
"""Dialect -> what builds it, without arguments."""


def open_dialect(name: str) -> Dialect:
    """Return an adapter by its name; raises UsageError for an unknown one."""
    return DIALECTS[name]()
