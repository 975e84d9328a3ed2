"""URLs of servers that somebody else runs: they name a host, and hold no secret that would be kept with results."""

from __future__ import annotations

import re
from collections.abc import Collection
from urllib.parse import parse_qsl, urlsplit

from s2a_bench.secrets import is_secret


def checked_url(url: str, schemes: Collection[str]) -> str:
    """Return a URL with one of the schemes, or ""; raises ValueError for any other text, without its password."""
    if not url:
        return url
    try:
        parts = urlsplit(url)
        sound = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound:
        shown = re.sub(r"[^/]*@", "***@", url.partition("?")[0])
        raise ValueError(f"'{shown}' should start with {' or '.join(f'{each}://' for each in schemes)} and name a host")
    if "@" in parts.netloc:
        raise ValueError("leave the password out, which would be kept with the results; see `api_key_env`")
    for name, _ in parse_qsl(parts.query, keep_blank_values=True):
        if is_secret(name):
            raise ValueError(f"leave '{name}' out, which would be kept with the results; see `api_key_env`")
    return url
