"""JSON Merge Patch (RFC 7396): how a user's own fields go into every request; null takes a field out."""

from __future__ import annotations

import json
from typing import Any

from s2a_bench.errors import UsageError
from s2a_bench.secrets import LONG, keep, secrets_in


def read_patch(text: str) -> dict[str, Any]:
    """Read the patch that a user wrote; raises UsageError for anything but a JSON object.

    What is under a secret's name is struck out of what is shown and kept from now on.
    """
    try:
        patch = json.loads(text or "{}")
        json.dumps(patch, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"`extra_body`: no JSON: {error}") from error
    if not isinstance(patch, dict):
        raise UsageError('`extra_body` should be a JSON object, such as \'{"reasoning_effort": "low"}\'')
    for name, value in secrets_in(patch):
        if len(value) < LONG:
            raise UsageError(
                f"`extra_body`: '{name}' is a secret's name, and its value too short to be told from other words when "
                f"it is struck out of the results; {LONG} letters are needed, or `api_key_env`"
            )
        keep(value)
    return patch


def merged(target: Any, patch: Any) -> Any:
    """Return ``target`` with ``patch`` applied; neither is changed."""
    if not isinstance(patch, dict):
        return patch
    result = dict(target) if isinstance(target, dict) else {}
    for name, value in patch.items():
        if value is None:
            result.pop(name, None)
        else:
            result[name] = merged(result.get(name), value)
    return result
