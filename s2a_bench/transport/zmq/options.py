"""What the ZeroMQ transport can be told."""

from __future__ import annotations

from typing import ClassVar, Final, Literal
from urllib.parse import urlsplit

from pydantic import field_validator

from s2a_bench.options import option
from s2a_bench.transport.listening import ListeningOptions
from s2a_bench.transport.observation import TemplateName
from s2a_bench.transport.options import SERVER

PREFIX: Final = "gr00t-"
"""How the templates of layouts begin."""


class ZmqOptions(ListeningOptions):
    """How our policy server over ZeroMQ is reached, or somebody else's is asked."""

    SCHEMES: ClassVar[tuple[str, ...]] = ("tcp",)

    layout: Literal["n1.6", "n1.5"] = option(
        "n1.6", "how GR00T arranges observations and actions: n1.6 (and later) or n1.5", side=SERVER
    )
    template: TemplateName | Literal[""] = option(
        "", "what the policy is told: a template's name, or a TOML or JSON file [default: gr00t- and the layout]"
    )

    @field_validator("url")
    @classmethod
    def _names_a_port(cls, url: str) -> str:
        if url and (not urlsplit(url).port or url.partition("//")[2] != urlsplit(url).netloc):
            raise ValueError(f"'{url.partition('?')[0]}' should look like tcp://HOST:PORT")
        return url

    @property
    def told_by(self) -> str:
        """Return the template."""
        return self.template or PREFIX + self.layout
