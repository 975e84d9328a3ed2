"""Run all pairs."""

from __future__ import annotations

import argparse
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

import cv2
import numpy as np

from benchmarks import http_shootout
from benchmarks.http_shootout import REPLY
from benchmarks.http_shootout.clients import CLIENTS, Ask
from benchmarks.http_shootout.servers import SERVERS

LEAN: Final = ("httptools, threads", "http.client")
"""The server that clients are compared on, and the client that servers are."""
WARM_UP: Final = 10


@contextmanager
def running(name: str) -> Iterator[int]:
    """Run a server in a process of its own and yield its port."""
    command = [sys.executable, "-m", "benchmarks.http_shootout", "--serve", name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - ours
        assert process.stdout  # noqa: S101 - for mypy
        try:
            yield int(process.stdout.readline())
        finally:
            process.kill()


def opened(make: Callable[[int], Ask], port: int) -> Ask:
    """Return a client whose server answers, for which it waits."""
    deadline = time.monotonic() + 60
    while True:
        try:
            ask = make(port)
            ask(memoryview(bytes(300)))
        except Exception:  # whatever a library raises while nobody listens
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
        else:
            return ask


def main() -> None:
    """Measure all pairs in turns, and print the table, the fastest first."""
    parser = argparse.ArgumentParser(
        description=http_shootout.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--rounds", type=int, default=150)
    parser.add_argument("--serve", choices=SERVERS)
    told = parser.parse_args()
    if told.serve:
        listener = socket.create_server(("127.0.0.1", 0))
        print(listener.getsockname()[1], flush=True)
        SERVERS[told.serve][1](listener)
        return
    width, height = map(int, told.size.split("x"))
    frame = np.random.default_rng(0).integers(0, 255, (height, width, 2), np.uint8)
    pairs = [
        *((server, LEAN[1]) for server in SERVERS),
        *((LEAN[0], client) for client in CLIENTS if client != LEAN[1]),
    ]
    pairs.append(("FastAPI on uvicorn", "httpx"))
    with ExitStack() as stack:
        asks = {}
        for server, client in pairs:
            try:
                for package in filter(None, (SERVERS[server][0], CLIENTS[client][0])):
                    version(package)
            except PackageNotFoundError as missing:
                print(f"left out: {server} with {client}: no {missing}", file=sys.stderr)
                continue
            asks[server, client] = opened(CLIENTS[client][1], stack.enter_context(running(server)))
        times: dict[Any, list[float]] = {pair: [] for pair in asks}
        for turn in range(told.rounds + WARM_UP):
            for pair, ask in random.sample(sorted(asks.items(), key=str), len(asks)):
                began = time.perf_counter_ns()
                answer = ask(memoryview(cv2.cvtColor(frame, cv2.COLOR_YUV2BGR_YUY2)).cast("B"))
                if turn >= WARM_UP:
                    times[pair].append((time.perf_counter_ns() - began) / 1e6)
                assert answer == REPLY, (pair, answer)  # noqa: S101 - a benchmark
    print(f"{told.size}, {told.rounds} rounds, ms from YUYV in the client to RGB in the server and back\n")
    print("| server | client | median | p99 |\n|---|---|---|---|")
    for (server, client), values in sorted(times.items(), key=lambda item: np.median(item[1])):
        print(f"| {server} | {client} | {np.median(values):.2f} | {np.percentile(values, 99):.1f} |")


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
