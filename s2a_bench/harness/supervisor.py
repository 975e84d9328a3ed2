"""A server that stays up: it lives in a process of its own, which is started again once when it dies."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from s2a_bench.harness.processes import OwnServer, ServerProcess
from s2a_bench.harness.serving import ServerJob

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def keep_serving(job: ServerJob, ready: Callable[[ServerProcess], None], died: Callable[[str], None]) -> None:
    """Serve until a signal comes; raises ServerDied at the second death.

    ``ready`` is called whenever the server has started, ``died`` with one line after the first death. The server that
    is started again has the first one's address.
    """
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        address = _serve_once(job, ready, lambda line: died(f"{line}; it is started again, once"))
        again = replace(job, wiring=replace(job.wiring, address=address, restarted=True))
        _serve_once(again, ready, None)


def _serve_once(job: ServerJob, ready: Callable[[ServerProcess], None], died: Callable[[str], None] | None) -> str:
    """Serve until the process ends and return the address; raises ServerDied where nobody wants to hear of it."""
    with OwnServer(job.wiring.transport, job) as server:
        server.wait_ready()
        ready(server)
        server.ends_within(None)
        death = server.death()
    if died is None:
        raise death
    died(str(death))
    return server.address
