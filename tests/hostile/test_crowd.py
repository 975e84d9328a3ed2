"""A thousand clients at once are answered or refused, and none hangs; nor do they without descriptors."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.types import Request
from tests.hostile.asking import usage
from tests.hostile.suite import honest_answer, own_server
from tests.hostile.tcp import connect, crowd, sends
from tests.hostile.wires.http import chat

CLIENTS = 1000


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
@pytest.mark.parametrize("stream", ["true", "false"])
def test_1000_clients_at_once(
    tmp_path: Path, variant: str, stream: str, record_property: Callable[[str, object], None]
) -> None:
    fields = f'"stream": {stream}, "max_tokens": 3, "request_id": "one of many"'
    wiring = wiring_of(f"http/{variant}")
    with own_server(wiring, tmp_path / "log") as server:
        here = replace(wiring, address=server.address)
        began = now_ns()
        replies = crowd(CLIENTS, sends(chat(fields=fields, path=PATHS[variant]), seconds=120))(here)
        seconds = (now_ns() - began) / 1e9
        whole = replies.count("data: [DONE]") if stream == "true" else replies.count('"completion_tokens":3')
        answered, refused = replies.count("HTTP/1.1 200 "), replies.count("HTTP/1.1 503 ")
        peak = usage(server.pid).peak_mib
        record_property("cost", f"1000 clients: {answered} answered, {seconds:.1f} s, {peak:.0f} MiB")
        assert answered + refused == CLIENTS
        assert whole == answered >= 65
        assert replies.count("retry-after: ") == refused or variant == "as-deployed"  # uvicorn's refusal has none
        assert peak < 1024
        client = open_client(here)
        try:
            assert len(ask(client, Request("afterwards", "go on", max_tokens=3))[0]) == 3
        finally:
            client.close()


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
def test_out_of_descriptors_those_that_are_connected_are_answered(variant: str, tmp_path: Path) -> None:
    wiring = wiring_of(f"http/{variant}")
    with own_server(wiring, tmp_path / "log") as server, ExitStack() as stack:
        here = replace(wiring, address=server.address)
        client = stack.enter_context(closing(open_client(here)))
        expected = honest_answer(client)
        limits = resource.prlimit(server.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (usage(server.pid).descriptors + 3, limits[1]))
        for _ in range(20):
            stack.enter_context(connect(here, 60))
        time.sleep(0.5)
        assert honest_answer(client) == expected
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, limits)
        assert sends(chat(path=PATHS[variant]), seconds=10)(here).startswith("HTTP/1.1 200 ")
    assert "Traceback" not in (tmp_path / "log").read_text()
