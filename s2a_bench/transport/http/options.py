"""Options of the HTTP transport, and JSON Merge Patch (RFC 7396) for `extra_body`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import field_validator

from s2a_bench.errors import UsageError
from s2a_bench.options import TextOrFile, one_of, option
from s2a_bench.secrets import LONG, keep, secrets_in
from s2a_bench.transport import PROGRAM, SERVING
from s2a_bench.transport.access import WebOptions
from s2a_bench.transport.http.dialects import DIALECTS

WHEEL = Path("xllamacpp")
"""Stands for llama.cpp's server in the wheel of that name."""


def read_patch(text: str) -> dict[str, Any]:
    """Read a user's patch; raises UsageError for anything but a JSON object.

    From now on the value of a secret's name is struck out of everything shown or kept.
    """
    try:
        patch = json.loads(text or "{}")
        json.dumps(patch, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"`extra_body`: not JSON: {error}") from error
    if not isinstance(patch, dict):
        raise UsageError('`extra_body` should be a JSON object, such as \'{"reasoning_effort": "low"}\'')
    for name, value in secrets_in(patch):
        if len(value) < LONG:
            raise UsageError(
                f"`extra_body`: '{name}' is a secret's name, and its value is too short to be struck out of the "
                f"results without harm to other words; {LONG} letters are needed, or `api_key_env`"
            )
        keep(value)
    return patch


def merged(target: Any, patch: Any) -> Any:
    """Return ``target`` with ``patch`` applied; neither is changed. A null removes a field."""
    if not isinstance(patch, dict):
        return patch
    result = dict(target) if isinstance(target, dict) else {}
    for name, value in patch.items():
        if value is None:
            result.pop(name, None)
        else:
            result[name] = merged(result.get(name), value)
    return result


class HttpOptions(WebOptions):
    """HTTP's own options; `Http.options` has those that dialects declare, too."""

    SCHEMES: ClassVar[tuple[str, ...]] = ("http", "https")
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {"port": 8080}
    NOT_SERVE_FLAGS: ClassVar[tuple[str, ...]] = ("api_docs",)

    connection: Literal["keep-alive", "per-request", "client-per-request"] = option(
        "keep-alive", "keep-alive, per-request (a new connection each), client-per-request (a new client object each)"
    )
    served_model: str = option("", "the model's name at the url [default: the first that it lists]")
    dialect: Annotated[str, one_of(lambda: ("", *DIALECTS))] = option(
        "", f"the url's dialect: {', '.join(DIALECTS)} [default: detected]"
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
        read_patch(text)
        return text

    def check(self) -> None:
        super().check()
        if self.url and self.llama_server:
            raise UsageError("`url` and `llama_server` name two HTTP servers; give one of them")
        for name in ("dialect", "extra_body"):
            if getattr(self, name) and not self.url:
                raise UsageError(f"`{name}` is about a server that runs already; name it with `url`")

    @property
    def spoken(self) -> str:
        return "llama-server" if self.llama_server else self.dialect

    @property
    def of_dialects(self) -> set[str]:
        """Return the options that dialects declare, of which the value is not the default."""
        fields = type(self).model_fields
        return {
            each for each in fields.keys() - HttpOptions.model_fields if getattr(self, each) != fields[each].default
        }

    @property
    def without_effect(self) -> set[str]:
        return set() if self.url else self.of_dialects
