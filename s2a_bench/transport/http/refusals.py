"""The error of a refused request: one line with the server's message and the way out, and how long to wait."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from typing import Any

import httpx

from s2a_bench.errors import RequestFailed
from s2a_bench.secrets import struck
from s2a_bench.transport.http.clients import HttpResponse
from s2a_bench.transport.http.dialects.decoder import error_in
from s2a_bench.transport.http.options import HttpOptions

NO_MODEL = re.compile(
    r"\bmodel\b.{0,200}?(not found|not exist|n't exist)|model_not_found|(invalid|unknown|no such) model",
    re.IGNORECASE | re.DOTALL,
)
"""Messages of servers, with any status, that they have no such model."""

QUOTED = 200
"""Characters that are quoted of a body that is no error object."""


def refusal(url: str, response: HttpResponse, body: str, options: HttpOptions, expected: str) -> RequestFailed:
    """Return the error for an answer with a wrong status or content type."""
    try:
        value = json.loads(body)
    except (ValueError, RecursionError):
        value = None
    message = error_in(value) or struck(body)[:QUOTED].strip() or "nothing"
    kind = response.headers.get("content-type", "no content type").partition(";")[0]
    if response.status_code == httpx.codes.OK and not kind.startswith(expected):
        message += f" (as {kind} where {expected} belongs; see `dialect`)"
    wait_s = _retry_after_s(response, value)
    wait = f"; it asks to wait {wait_s:g} s" if wait_s else ""
    advice = advice_for(response.status_code, message, options, moved=response.headers.get("location", ""))
    line = f"{url} answered {response.status_code}: {' '.join(message.split())}{wait}{'; ' if advice else ''}{advice}"
    return RequestFailed(line, retry_after_s=wait_s)


def advice_for(status: int, message: str, options: HttpOptions, *, moved: str = "") -> str:
    """Return the way out for a status or a known message, or nothing."""
    if httpx.codes.is_redirect(status):
        return f"it moved: give {moved or 'its new place'} to `url`"
    if NO_MODEL.search(message):
        return f"name a model that it has with `served_model` (now '{options.served_model}')"
    key = f"the key in ${options.api_key_env} is not accepted"
    no_key = "name the environment variable that holds its key with `api_key_env`"
    return {
        401: key if options.api_key_env else no_key,
        403: key if options.api_key_env else no_key,
        404: f"see `url`, `dialect` and `served_model` (now '{options.served_model}')",
        413: "choose a smaller `size`, or `payload` jpeg",
        429: "it wants fewer requests: see its quota, or `requests`",
    }.get(status, "")


def _retry_after_s(response: HttpResponse, body: Any) -> float | None:
    """Return how long the server asks to wait: seconds in the header, or Google's RetryInfo in the body.

    A date (RFC 9110, 10.2.3) is ignored: it comes from another host's clock.
    """
    with suppress(ValueError):
        return max(0.0, float(response.headers.get("retry-after", "")))
    try:
        delays = [detail["retryDelay"] for detail in body["error"]["details"] if "retryDelay" in detail]
        return max(0.0, float(delays[0].removesuffix("s")))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError):
        return None
