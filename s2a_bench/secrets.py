"""The secrets of this process, which are removed from everything that is shown or stored.

A server may send a key back in an error, a header or its answer: plain, percent-encoded, in JSON's escapes, in Base64,
alone or as the credentials of a header.
"""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Iterator, Sequence
from typing import Any, Final
from urllib.parse import quote

LONG: Final = 8
"""A shorter secret, as the placeholder `ollama`, is removed from servers' messages only, as a separate word."""
STRUCK: Final = "***"

_long: dict[str, str] = {}
_short: dict[str, str] = {}
"""Secret -> its pattern."""

_NAME = re.compile(
    r"(?:^|_)(?:key|token|secret|pass(?:word|wd|phrase)?|pwd|auth|authorization|credentials?|bearer|jwt|cookie|sig(?:nature)?)$"
    r"|(?:api|access|secret|private)_?key$"
)
_NO_SECRET = re.compile(r"(?:stop|eos|bos|pad|unk|cls|sep|mask)_token$|cache_key$")


def is_secret(name: str) -> bool:
    """Return whether a name looks like that of a secret: ``api_key``, ``accessToken``, ``X-Auth``."""
    snake_case = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[^A-Za-z0-9]+", "_", name).strip("_").lower()
    return bool(_NAME.search(snake_case)) and not _NO_SECRET.search(snake_case)


def secrets_in(value: Any, name: str = "", *, inside: bool = False) -> Iterator[tuple[str, str]]:
    """Yield name and text of every value of a JSON object under a secret's name, at any depth."""
    if isinstance(value, dict):
        for key, item in value.items():
            secret = inside or is_secret(key)
            yield from secrets_in(item, name if inside else key, inside=secret)
    elif isinstance(value, list):
        for item in value:
            yield from secrets_in(item, name, inside=inside)
    elif inside and isinstance(value, (str, int)) and not isinstance(value, bool) and value != "":
        yield name, str(value)


def keep(secret: str) -> None:
    """Remove a secret from now on."""
    if len(secret) >= LONG:
        _long.setdefault(secret, "|".join(map(re.escape, _forms(secret))))
    elif secret:
        _short.setdefault(secret, rf"(?<!\w){re.escape(secret)}(?!\w)")


def struck(text: str, *, short: bool = True) -> str:
    """Return a text without the secrets; with the ``short`` ones too, as in servers' messages."""
    patterns = [*_long.values(), *(_short.values() if short else ())]
    return re.sub("|".join(patterns), STRUCK, text) if patterns else text


def struck_pieces(texts: Sequence[str]) -> list[str]:
    """Return the pieces of one text; if a secret is in it, perhaps over several, the first piece is all the rest."""
    whole = "".join(texts)
    shown = struck(whole)
    return [*texts] if shown == whole else [shown, *[""] * (len(texts) - 1)]


def _forms(secret: str) -> list[str]:
    """Return the forms of a secret, each before the ones that begin like it."""
    whole = [secret, f"Bearer {secret}", f"Api-Key {secret}"]
    in_base64 = [b64encode(text.encode()).decode().rstrip("=") for text in whole]
    in_json = json.dumps(secret)[1:-1]
    return sorted({secret, quote(secret, safe=""), in_json, in_json.replace("/", "\\/"), *in_base64}, key=len)[::-1]
