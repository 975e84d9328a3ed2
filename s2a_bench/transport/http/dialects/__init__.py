"""What HTTP servers speak: one adapter a dialect, without any I/O, built in or offered by a package.

An adapter builds a request's body and says what one message of the answer means. Cutting the bytes into messages is
the `Decoder`'s; sending, marking stages and telling errors are the client's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from s2a_bench.registry import Registry
from s2a_bench.trace import Remote
from s2a_bench.types import Action

if TYPE_CHECKING:
    from s2a_bench.transport.http.dialects.common import Dialect

NATIVE = "s2a"
"""The dialect of our own server, in all its variants."""


@dataclass(frozen=True, slots=True)
class EncodedPicture:
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


DIALECTS: Final[Registry[Callable[[], Dialect]]] = Registry(
    "dialects",
    "dialect",
    {
        NATIVE: "s2a_bench.transport.http.dialects.openai:Native",
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
