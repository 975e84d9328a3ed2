"""What the HTTP transport can be told."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator

from s2a_bench.errors import UsageError
from s2a_bench.transport.options import SERVER, Options


class HttpOptions(Options):
    """How our HTTP server is reached, or somebody else's is asked."""

    connection: Literal["keep-alive", "per-request", "client-per-request"] = Field(
        "keep-alive", description="a connection for all requests, a new one each, a new client object each"
    )
    host: str = Field("127.0.0.1", description="address that our server binds", json_schema_extra=SERVER)
    port: int = Field(0, ge=0, le=65535, description="port of the server; 0: any free one", json_schema_extra=SERVER)
    url: str = Field("", description="a server that runs already (a black box)", json_schema_extra=SERVER)
    served_model: str = Field("default", description="the model's name at the url")
    dialect: str = Field("", description="what the url speaks [default: ask]")
    api_key_env: str = Field("", description="NAME of the environment variable with the API key of the url")
    extra_body: str = Field("", description="JSON merged into every request to the url (RFC 7396)")
    llama_server: Path | None = Field(
        None, description="start this llama.cpp server on the same model files (a black box)", json_schema_extra=SERVER
    )

    @field_validator("url")
    @classmethod
    def _names_a_server(cls, url: str) -> str:
        if url and not _is_url(url):
            raise ValueError(f"'{url}' should start with http:// or https:// and name a host")
        if url and "@" in urlsplit(url).netloc:
            raise ValueError("leave the password out, which would be kept with the results; see `api_key_env`")
        return url

    @field_validator("dialect")
    @classmethod
    def _is_spoken(cls, dialect: str) -> str:
        from s2a_bench.transport.http.dialects import DIALECTS

        if dialect and dialect not in DIALECTS:
            raise ValueError(f"'{dialect}' is none of {', '.join(DIALECTS)}")
        return dialect

    @field_validator("extra_body")
    @classmethod
    def _is_a_patch(cls, text: str) -> str:
        from s2a_bench.transport.http.merge import read_patch

        read_patch(text)
        return text

    def check(self) -> None:
        """Refuse two servers, and what is about a server that is not there."""
        if self.url and self.llama_server:
            raise UsageError("`url` and `llama_server` name two HTTP servers; give one of them")
        for name in ("dialect", "api_key_env", "extra_body"):
            if getattr(self, name) and not self.url:
                raise UsageError(f"`{name}` is about a server that runs already; name it with `url`")

    @property
    def spoken(self) -> str:
        """Return the dialect that a black box is known to speak, or nothing."""
        return "llama-server" if self.llama_server else self.dialect


def _is_url(text: str) -> bool:
    """Whether a text names an HTTP server."""
    try:
        parts = urlsplit(text)
        return parts.scheme in {"http", "https"} and bool(parts.hostname) and parts.port != 0
    except ValueError:
        return False
