"""Print what checksums of pixels cost: e2e with and without them, in one interleaved run over our own HTTP server."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from random import Random
from statistics import median, quantiles
from threading import Thread

from s2a_bench.frames import open_source
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import RunPlan, resolve
from s2a_bench.harness.serving import engine_handler
from s2a_bench.harness.session import Place, Session
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.trace import budget
from s2a_bench.transport import open_client, open_server
from s2a_bench.transport.pipeline import Pipeline, one_pipeline


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transport", default="http/binary?payload=raw")
    parser.add_argument("--requests", type=int, default=300)
    arguments = parser.parse_args()
    cell = one_pipeline(arguments.transport)
    plan = resolve(RequestsConfig(transports=arguments.transport, max_tokens=4), print)
    e2e_ms: dict[bool, list[float]] = {True: [], False: []}
    with ExitStack() as stack:
        sessions = {pixels: _session(cell, plan, stack, pixels=pixels) for pixels in e2e_ms}
        random = Random(0)  # noqa: S311 - an order, not a secret
        for block in range(arguments.requests):
            for pixels in random.sample([True, False], 2):
                sample = sessions[pixels].measure(Place(block, 0, warmup=False)).sample
                if sample.error:
                    raise SystemExit(sample.error)
                e2e_ms[pixels].append(budget(sample.marks).e2e_ns / 1e6)
    for pixels, values in e2e_ms.items():
        low, _, high = quantiles(values, n=4)
        name = "with checksums" if pixels else "without"
        print(f"{name:15} e2e median {median(values):.3f} ms, quartiles {low:.3f} and {high:.3f}, n = {len(values)}")


def _session(cell: Pipeline, plan: RunPlan, stack: ExitStack, *, pixels: bool) -> Session:
    """Open a server, a client and a camera of their own."""
    engine = open_engine(EngineConfig(name="echo"))
    server = open_server(cell.wiring(), engine_handler(engine, pixels=pixels))
    Thread(target=server.serve, daemon=True).start()
    stack.callback(server.stop)
    client = open_client(cell.wiring(server.address))
    stack.callback(client.close)
    source = open_source("synthetic", *plan.feed.size, fps=30.0, seed=0)
    stack.callback(source.close)
    return Session(cell, client, RequestFeed(source, preencoded=False), plan.request)


if __name__ == "__main__":
    main()
