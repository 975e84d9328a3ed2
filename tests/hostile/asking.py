"""A process that makes one request for each wiring on a line of its standard input, and the memory that processes use.

Outcomes go to standard output. A separate process can be measured alone, and killed if it hangs.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import closing, suppress
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
    rss_mib: float
    peak_mib: float
    """The most resident memory (VmHWM) since the start, or since `forget_peak`."""
    threads: int
    descriptors: int


def family(pid: int) -> Iterator[int]:
    with suppress(OSError):
        tasks = [*(PROC / str(pid) / "task").iterdir()]
        yield pid
        for task in tasks:
            with suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from family(int(child))


def usage(pid: int) -> Usage:
    rss, peak, threads, descriptors = 0, 0, 0, 0
    for member in family(pid):
        with suppress(OSError):  # it has just ended
            lines = (PROC / str(member) / "status").read_text().splitlines()
            status = {name: value.split() for name, _, value in (line.partition(":\t") for line in lines)}
            rss += int(status.get("VmRSS", "0")[0])
            peak += int(status.get("VmHWM", "0")[0])
            threads += int(status["Threads"][0])
            descriptors += len([*(PROC / str(member) / "fd").iterdir()])
    return Usage(rss / 1024, peak / 1024, threads, descriptors)


def forget_peak(pid: int) -> None:
    """Reset the peak (proc(5), clear_refs), if that is allowed."""
    for member in family(pid):
        with suppress(OSError):
            (PROC / str(member) / "clear_refs").write_text("5")


TOKENS = 8


def one_request(wiring: Wiring[Any]) -> dict[str, Any]:
    """Make one request; return its number of tokens, its error, and its cost."""
    forget_peak(pid := os.getpid())
    began, error, tokens = now_ns(), "", 0
    trace = Trace()
    trace.mark(RESIDUAL)
    try:
        with closing(open_client(wiring)) as client:
            for _ in client.request(Request("honest", "go on", max_tokens=TOKENS), trace):
                tokens += 1
    except S2AError as failure:
        error = f"{type(failure).__name__}: {failure}"
    except Exception as failure:  # noqa: BLE001 - the finding
        error = f"Traceback: {failure!r} {traceback.format_exc(limit=-3)}"
    cost = {"seconds": (now_ns() - began) / 1e9, "peak_mib": usage(pid).peak_mib}
    return {"tokens": tokens, "error": error, **cost}


def main() -> None:
    for line in sys.stdin:
        sys.stdout.write(json.dumps(one_request(Wiring.from_json(json.loads(line)))) + "\n")
        sys.stdout.flush()
