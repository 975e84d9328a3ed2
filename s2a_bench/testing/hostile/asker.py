"""A process that asks one server after the other: a wiring a line on standard input, what came of it on its output.

It is a process of its own so that its memory is its own, and so that it can be ended where it hangs.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError
from s2a_bench.testing.hostile.usage import forget_peak, usage
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Wiring, open_client
from s2a_bench.types import Request

TOKENS = 8


def asked(told: Wiring[Any]) -> dict[str, Any]:
    """Make one request; return its tokens and error, and what it cost."""
    forget_peak(pid := os.getpid())
    began, error, texts = now_ns(), "", []
    trace = Trace()
    trace.mark(RESIDUAL)
    try:
        client = open_client(told)
        try:
            for token in client.request(Request("honest", "go on", max_tokens=TOKENS), trace):
                texts.append(token.text[:100])  # noqa: PERF401 - those before an error are kept
        finally:
            client.close()
    except S2AError as failure:
        error = f"{type(failure).__name__}: {failure}"
    except Exception as failure:  # noqa: BLE001 - the finding
        error = f"Traceback: {failure!r} {traceback.format_exc(limit=-3)}"
    took = {"seconds": (now_ns() - began) / 1e9, "peak_mib": usage(pid).peak_mib}
    return {"tokens": len(texts), "error": error, **took}


def main() -> None:
    """Answer until standard input ends."""
    for line in sys.stdin:
        sys.stdout.write(json.dumps(asked(Wiring.from_json(json.loads(line)))) + "\n")
        sys.stdout.flush()
