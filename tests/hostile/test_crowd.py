"""A thousand clients at once are answered or refused, and none hangs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.types import Request
from tests.hostile.asking import usage
from tests.hostile.suite import own_server
from tests.hostile.tcp import crowd, sends
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
        assert replies.count("retry-after: ") == refused
        assert peak < 1024
        client = open_client(here)
        try:
            assert len(ask(client, Request("afterwards", "go on", max_tokens=3))[0]) == 3
        finally:
            client.close()
