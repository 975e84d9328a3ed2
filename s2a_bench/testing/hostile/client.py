"""A process that asks one server after the other, and what processes use: a wiring a line on standard input.

What came of it goes to standard output. It is a process of its own so that its memory is its own, and so that it can be
ended where it hangs.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Wiring, open_client
from s2a_bench.types import Request

PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Usage:
    """Of a process and its children together."""

    rss_mib: float
    peak_mib: float
    """The most resident memory (VmHWM) since the start, or since `forget_peak`."""
    threads: int
    descriptors: int


def family(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants that run."""
    with suppress(OSError):
        tasks = [*(PROC / str(pid) / "task").iterdir()]
        yield pid
        for task in tasks:
            with suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from family(int(child))


def usage(pid: int) -> Usage:
    """Return what a process and its descendants use."""
    rss, peak, threads, descriptors = 0, 0, 0, 0
    for member in family(pid):
        with suppress(OSError):  # it has just ended
            lines = (PROC / str(member) / "status").read_text().splitlines()
            said = {
                name: value.split()[0] for name, _, value in (line.partition(":\t") for line in lines) if value.strip()
            }
            rss += int(said.get("VmRSS", 0))
            peak += int(said.get("VmHWM", 0))
            threads += int(said["Threads"])
            descriptors += len([*(PROC / str(member) / "fd").iterdir()])
    return Usage(rss / 1024, peak / 1024, threads, descriptors)


def forget_peak(pid: int) -> None:
    """Let the peak begin anew (proc(5), clear_refs), where that is allowed."""
    for member in family(pid):
        with suppress(OSError):
            (PROC / str(member) / "clear_refs").write_text("5")


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
