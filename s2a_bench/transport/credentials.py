"""API keys: read from the environment by the variable's name, never from a flag, and never shown."""

from __future__ import annotations

import hmac
import os
import re
from ipaddress import ip_address

from s2a_bench.errors import UsageError
from s2a_bench.secrets import keep

VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def read_key(variable: str) -> str:
    """Return the key that an environment variable holds, without space around it; "" for no variable.

    From now on it is struck out of what is shown and kept.

    Raises UsageError, which does not repeat the name: somebody may have given the key itself.
    """
    if not variable:
        return ""
    if not VARIABLE.fullmatch(variable):
        raise UsageError("`api_key_env` takes the name of an environment variable, not the key itself")
    key = os.environ.get(variable, "").strip()
    if not key:
        raise UsageError("`api_key_env`: the environment has no such variable, or it is empty; export it first")
    if not (key.isascii() and key.isprintable()):
        raise UsageError(f"`api_key_env`: ${variable} holds what no HTTP header can carry")
    keep(key)
    return key


def key_for(host: str, variable: str, *, everybody: bool) -> str:
    """Return the key that the clients of a server must send, "" for none; ``variable`` names where it is.

    Raises UsageError where strangers reach ``host`` without a key and nobody said that ``everybody`` may.
    """
    key = read_key(variable)
    if not (key or everybody or ip_address(host).is_loopback):
        raise UsageError(
            f"`host`: others reach {host}; name the environment variable that holds the key that they must send with "
            "`api_key_env`, or let everybody in with `no_auth`"
        )
    return key


def has_key(said: bytes, scheme: str, key: bytes) -> bool:
    """Whether an Authorization header has the key, compared in constant time (RFC 6750, 2.1)."""
    name, _, token = said.partition(b" ")
    return name.lower() == scheme.lower().encode() and hmac.compare_digest(token.strip(), key)
