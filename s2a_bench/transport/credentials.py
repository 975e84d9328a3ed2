"""API keys: read from the environment by the variable's name, never from a flag, and never shown."""

from __future__ import annotations

import os
import re

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
