"""What the ZeroMQ transport can be told."""

from __future__ import annotations

from typing import Final, Literal
from urllib.parse import urlsplit

from pydantic import field_validator

from s2a_bench.errors import UsageError
from s2a_bench.options import option
from s2a_bench.transport.observation import TemplateName
from s2a_bench.transport.options import SERVER, SERVING, Options
from s2a_bench.transport.urls import checked_url

SCHEMES: Final = ("tcp",)
PREFIX: Final = "gr00t-"
"""How the templates of layouts begin."""


class ZmqOptions(Options):
    """How our policy server over ZeroMQ is reached, or somebody else's is asked."""

    layout: Literal["n1.6", "n1.5"] = option(
        "n1.6", "how GR00T arranges observations and actions: n1.6 (and later) or n1.5", side=SERVER
    )
    host: str = option("127.0.0.1", "address that our server binds; others than this machine need a key", side=SERVING)
    port: int = option(0, "port of the server; 0: any free one", ge=0, le=65535, side=SERVER)
    url: str = option("", "a policy server that runs already (a black box)", side=SERVER)
    template: TemplateName | Literal[""] = option(
        "", "what the policy is told: a template's name, or a TOML or JSON file [default: gr00t- and the layout]"
    )
    api_key_env: str = option(
        "", "NAME of the environment variable with the API key: of the url, or that our server wants", side=SERVER
    )
    no_auth: bool = option(False, "let everybody in who reaches the host, without a key", side=SERVING)

    @field_validator("url")
    @classmethod
    def _names_a_server(cls, url: str) -> str:
        checked_url(url, SCHEMES)
        if url and (not urlsplit(url).port or url.partition("//")[2] != urlsplit(url).netloc):
            raise ValueError(f"'{url.partition('?')[0]}' should look like tcp://HOST:PORT")
        return url

    def check(self) -> None:
        """Refuse a key that nobody needs."""
        if self.no_auth and self.api_key_env:
            raise UsageError("`no_auth` lets everybody in without the key of `api_key_env`; give one of them")

    @property
    def told_by(self) -> str:
        """Return the template."""
        return self.template or PREFIX + self.layout
