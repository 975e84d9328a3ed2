"""A server that stays up: it lives in a process of its own, which is started again once when it dies."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from s2a_bench.errors import ServerDied
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
        address, death = _serve(job, ready)
        died(f"{death}; it is started again, once")
        _, death = _serve(replace(job, wiring=replace(job.wiring, address=address, restarted=True)), ready)
        raise death


def _serve(job: ServerJob, ready: Callable[[ServerProcess], None]) -> tuple[str, ServerDied]:
    """Serve until the process ends; return its address, and how it ended."""
    with OwnServer(job.wiring.transport, job) as server:
        server.wait_ready()
        ready(server)
        server.ends_within(None)
        return server.address, server.death()
