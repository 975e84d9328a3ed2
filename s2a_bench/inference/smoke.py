"""See whether llama.cpp answers at all: the tiny dummy in every type of weights, in a process of its own.

A build for another processor, or by a compiler whose code for AMX does not work, dies by an illegal instruction, and
perhaps with quantised weights only. So ``python -m s2a_bench.inference.smoke`` is what `make setup`, the doctor and
the tests start; it ends with 0, or with one line on standard error and, where the process was killed, 128 and its
signal.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

from s2a_bench.errors import EngineError
from s2a_bench.exits import how_it_ended
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.dummy import write_dummy
from s2a_bench.inference.files_config import Quant

CHILD = [sys.executable, "-m", "s2a_bench.inference.smoke"]
"""The process that may die; it gets a folder for the dummies."""
LONGEST_S = 600.0
TOKENS = 6


@dataclass(frozen=True, slots=True)
class Smoke:
    """What was seen: the child's return code, and one line with the way out unless that is 0."""

    code: int
    message: str = ""


def smoke_test() -> Smoke:
    """Run the test in a child process, in seconds; leaves no file behind."""
    with TemporaryDirectory(prefix="s2a-bench-smoke-") as folder:
        try:
            done = subprocess.run(  # noqa: S603 - our own command
                [*CHILD, folder], capture_output=True, text=True, errors="replace", check=False, timeout=LONGEST_S
            )
        except subprocess.TimeoutExpired:
            return Smoke(1, f"llama.cpp gave no answer within {LONGEST_S:.0f} s; stop what else runs, and try again")
    if not done.returncode:
        return Smoke(0)
    quant = (done.stdout.split() or ["no"])[-1]
    how = how_it_ended(done.returncode)
    said = done.stderr.strip().splitlines() if done.returncode > 0 else []
    return Smoke(done.returncode, ": ".join([f"llama.cpp failed its test with {quant} weights", how, *said[-1:]]))


def answer(folder: Path) -> None:
    """Let a dummy of every type answer about a picture, naming each type on standard output before it may die."""
    import numpy as np

    from s2a_bench.inference.llama_cpp import LlamaCppEngine
    from s2a_bench.types import Frame, Request

    frame = Frame(0, 0, 64, 48, "rgb8", np.zeros((48, 64, 3), np.uint8))
    for quant in get_args(Quant):
        print(quant, flush=True)  # noqa: T201 - the parent reads it
        model, mmproj = write_dummy(folder, "tiny", quant)
        engine = LlamaCppEngine(EngineConfig(model=model, mmproj=mmproj, threads=2))
        count = sum(1 for _ in engine.generate(Request("smoke", "stop at the red line", (frame,), TOKENS)))
        engine.close()
        if count != TOKENS:
            raise EngineError(f"{count} tokens instead of {TOKENS}")


def main() -> int:
    """Run the test, or with a folder as argument be its child."""
    if len(sys.argv) > 1:
        answer(Path(sys.argv[1]))
        return 0
    seen = smoke_test()
    if seen.message:
        print(seen.message, file=sys.stderr)  # noqa: T201 - for `make setup` and for shells
    return 128 - seen.code if seen.code < 0 else seen.code


if __name__ == "__main__":
    sys.exit(main())
