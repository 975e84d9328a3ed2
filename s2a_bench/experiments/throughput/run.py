"""The throughput run: tokens a second in this process, over transports, and of llama-bench.

llama.cpp's ``llama-bench`` is a reference on the same file and settings, one run a block. Its ``tg`` test decodes
random tokens, without sampling or text. It starts after ``--n-depth`` tokens, as many as our prompts have: attention
costs more with a longer context.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import COMPILE_AGAIN, EngineError, how_it_ended
from s2a_bench.experiments.throughput.config import IN_PROCESS, ThroughputConfig
from s2a_bench.experiments.throughput.metrics import REFERENCE, ReferenceRow
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.processes import llama_flags
from s2a_bench.harness.rounds import RunningLaunch, Task, in_blocks, run_requests
from s2a_bench.harness.session import Place
from s2a_bench.progress import Progress

LONGEST_S = 7200
"""Long enough for a board with half a token a second."""


def run_throughput(config: ThroughputConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder, which keeps the samples so far if S2AError or KeyboardInterrupt is raised."""

    def drive(launch: RunningLaunch) -> None:
        in_blocks(launch, [partial(llama_bench, config.reference, launch)] if config.reference else [])

    sampling = "greedy" if config.greedy else "model"
    plan = resolve(config.but(engine=config.engine.but(sampling=sampling)), progress.say)
    cells = tuple(
        replace(cell, name=cell.name.replace(cell.transport.name, IN_PROCESS, 1)) if cell.transport.in_process else cell
        for cell in plan.cells
    )
    return run_requests(Task("throughput", drive=drive), replace(plan, cells=cells), output, progress)


def llama_bench(program: Path, launch: RunningLaunch, place: Place) -> None:
    """Run llama-bench once, after as many tokens as our longest prompt has, and write its row."""
    engine, depth = launch.plan.engine, max(session.prompt_n for session in launch.sessions)
    command = [str(program), *llama_flags(engine), "--output", "json", "--repetitions", "1", "--n-prompt", "0"]
    command += ["--n-gen", str(launch.plan.request.max_pieces), "--n-depth", str(depth)]
    launch.writer.update(reference={"command": command})
    started_ns = now_ns()
    test = _timed(program, command, engine.flash_attention)
    row = ReferenceRow(
        **asdict(place),
        started_ns=started_ns,
        finished_ns=now_ns(),
        n_gen=test["n_gen"],
        depth=test.get("n_depth", 0),
        decode_ns=test["samples_ns"][0],
        facts={name: test[name] for name in test if not name.startswith(("samples", "avg", "stddev"))},
    )
    launch.writer.append(REFERENCE, [row])


def _timed(program: Path, command: list[str], flash_attention: str) -> dict[str, Any]:
    """Return llama-bench's JSON of its one test; raises EngineError."""
    try:
        done = subprocess.run(  # noqa: S603 - the user's own program
            command, capture_output=True, text=True, errors="replace", check=False, timeout=LONGEST_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EngineError(f"--reference {program}: {error}") from error
    last_line = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1][:200]
    if done.returncode:
        how = how_it_ended(done.returncode, COMPILE_AGAIN)
        raise EngineError(f"--reference {program}: {how}: {last_line}")
    try:
        (test,) = json.loads(done.stdout)
        if not (test["n_gen"] > 0 and test["samples_ns"][0] > 0):
            raise ValueError("it generated nothing")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise EngineError(
            f"--reference {program}: its answer is not llama-bench's JSON of one test ({error!r}); "
            "a llama-bench of 2026 is needed"
        ) from error
    if isinstance(test.get("flash_attn"), bool) and flash_attention != "off":
        raise EngineError(
            f"--reference {program}: it is too old for --flash-attn {flash_attention}, which it reads "
            "as off, and would measure other settings; take a newer one, or --flash-attention off"
        )
    return dict(test)
