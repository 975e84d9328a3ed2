"""What the `return` of a token takes above its floor, two wake-ups of a waiting process, for each transport.

One wake-up is measured here, before and after the run: a process that has slept sends its time through a pipe to one
that waits for it. ``python -m benchmarks.wakeups [TRANSPORTS]``; some minutes, and it wants a quiet machine.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection

TRANSPORTS = "http,ros,ros/action,iceoryx2,loopback"
OPTIONS = ("--payload", "raw", "--launches", "3", "--requests", "60")
SAMPLES, PAUSE_S = 400, 0.001


def send_times(sending: Connection) -> None:
    """Send the time, again and again, after a pause that lets the other process fall asleep."""
    for _ in range(SAMPLES):
        time.sleep(PAUSE_S)
        sending.send_bytes(time.monotonic_ns().to_bytes(8, "little"))


def wake_up_ms() -> float:
    """Return the median time from a send in one process until another, which waited for it, runs."""
    context = get_context("spawn")
    waiting, sending = context.Pipe(duplex=False)
    process = context.Process(target=send_times, args=(sending,))
    process.start()
    took = [-int.from_bytes(waiting.recv_bytes(), "little") + time.monotonic_ns() for _ in range(SAMPLES)]
    process.join()
    return statistics.median(took) / 1e6


def main() -> None:
    """Measure, and print a line for each pipeline."""
    floors = [wake_up_ms()]
    transports = sys.argv[1] if len(sys.argv) > 1 else TRANSPORTS
    with tempfile.TemporaryDirectory() as folder:
        command = (sys.executable, "-m", "s2a_bench", "latency", "--engine", "echo", "--transport", transports)
        whole = (*command, *OPTIONS, "--json", "--output", folder)
        done = subprocess.run(whole, stdout=subprocess.PIPE, check=True)  # noqa: S603 - ours
    floors.append(wake_up_ms())
    floor = 2 * statistics.mean(floors)
    print(f"floor: {floor:.3f} ms, two wake-ups of {floors[0]:.3f} and {floors[1]:.3f} ms, before and after the run")
    for cell in json.loads(done.stdout)["cells"]:
        took = cell["stages_ms"]["return"]["median"]
        print(f"{cell['cell']:24} return {took:.3f} ms, {took - floor:+.3f} above the floor")


if __name__ == "__main__":
    main()
