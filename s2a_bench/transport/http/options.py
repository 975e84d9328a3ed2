"""What the HTTP transport can be told."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import field_validator

from s2a_bench.errors import UsageError
from s2a_bench.options import TextOrFile, one_of, option
from s2a_bench.transport import PROGRAM, SERVING, Program
from s2a_bench.transport.access import WebOptions
from s2a_bench.transport.http.dialects import DIALECTS

WHEEL = Path("xllamacpp")
"""Stands for llama.cpp's server out of the wheel of that name."""


class HttpOptions(WebOptions):
    """How our HTTP server is reached, or somebody else's is asked."""

    SCHEMES: ClassVar[tuple[str, ...]] = ("http", "https")
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {"port": 8080}
    NOT_SERVE_FLAGS: ClassVar[tuple[str, ...]] = ("api_docs",)

    connection: Literal["keep-alive", "per-request", "client-per-request"] = option(
        "keep-alive", "keep-alive, per-request (a new connection each), client-per-request (a new client object each)"
    )
    served_model: str = option("", "the model's name at the url [default: the first that it lists]")
    dialect: Annotated[str, one_of(lambda: ("", *DIALECTS))] = option(
        "", f"what the url speaks: {', '.join(DIALECTS)} [default: ask]"
    )
    api_docs: bool = option(False, "also serve /openapi.json, /docs and /redoc", side=SERVING)
    extra_body: TextOrFile = option("", "JSON, or @FILE, merged into every request to the url (RFC 7396)")
    llama_server: Path | None = option(
        None,
        "llama.cpp's own server for http/llama-server [default: on PATH, else the wheel's]",
        side=PROGRAM,
        risk="program",
    )

    @field_validator("extra_body")
    @classmethod
    def _is_a_patch(cls, text: str) -> str:
        from s2a_bench.transport.http.merge import read_patch

        read_patch(text)
        return text

    def check(self) -> None:
        """Refuse two servers, what is about a server that is not there, and a key that nobody needs."""
        super().check()
        if self.url and self.llama_server:
            raise UsageError("`url` and `llama_server` name two HTTP servers; give one of them")
        for name in ("dialect", "extra_body"):
            if getattr(self, name) and not self.url:
                raise UsageError(f"`{name}` is about a server that runs already; name it with `url`")

    @property
    def spoken(self) -> str:
        """Return the dialect that a black box is known to speak, or nothing."""
        return "llama-server" if self.llama_server else self.dialect

    @property
    def program(self) -> Program | None:
        """Return llama.cpp's server where its program is named."""
        if self.llama_server is None:
            return None
        kind = "llama-server-wheel" if self.llama_server == WHEEL else "llama-server"
        return Program(kind, self.llama_server, self.port)
