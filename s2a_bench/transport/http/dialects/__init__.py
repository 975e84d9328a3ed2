"""Dialects of HTTP servers: one adapter for each, without any I/O, built in or from a package.

An adapter builds a request's body and reads one message of an answer. The `Decoder` cuts bytes into messages; the
client sends, marks stages and reports errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry
from s2a_bench.trace import Remote
from s2a_bench.types import Action

if TYPE_CHECKING:
    from s2a_bench.transport.http.dialects.common import Dialect
    from s2a_bench.transport.http.options import HttpOptions

NATIVE = "s2a"
"""The dialect of our server, in all its variants."""


@dataclass(frozen=True, slots=True)
class EncodedPicture:
    media_type: str
    base64: str


@dataclass(frozen=True, slots=True)
class Event:
    """The content of one message of an answer; a field at its default is absent.

    ``text`` is a piece of the answer, ``thinking`` a piece of a model's thoughts before it, ``finish`` the reason why
    the answer is complete, ``error`` the reason why it never will be.
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
    """The HTTP status of the error if it had come before the stream, 0 if unknown."""


DIALECTS: Final[Registry[type[Dialect]]] = Registry(
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
    },
)


def open_dialect(name: str, options: HttpOptions | None = None) -> Dialect:
    """Return a new adapter that has read the options, if any.

    Raises UsageError for an unknown name and for an option of another dialect, MissingExtra.
    """
    dialect = DIALECTS[name]()
    if options is not None:
        own = dialect.options.model_fields if dialect.options else {}
        for unread in options.of_dialects.difference(own, options.without_effect):
            takers = [each for each, kind in DIALECTS.loaded() if kind.options and unread in kind.options.model_fields]
            choice = f"leave it out, or choose `dialect` {' or '.join(takers)}"
            raise UsageError(f"`{unread}`: the dialect '{name}' takes none; {choice}")
        dialect.configure(options)
    return dialect
