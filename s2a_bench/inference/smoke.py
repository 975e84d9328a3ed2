"""Test llama.cpp's build: the tiny dummy in every type of weights answers, in a child process.

A build for another processor, or by a compiler whose code for AMX does not work, dies of an illegal instruction, and
perhaps with quantised weights only. `make setup`, the doctor and the tests therefore start
``python -m s2a_bench.inference.smoke``; it ends with 0, or with one line on standard error and, if the child was
killed, 128 plus its signal.
"""

from __future__ import annotations

import platform
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, get_args

import numpy as np

from s2a_bench import extras
from s2a_bench.errors import EngineError, how_it_ended
from s2a_bench.inference import EngineConfig, Quant
from s2a_bench.inference.dummy import write_dummy
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.machine.doctor.gpu import has_nvidia
from s2a_bench.types import Frame, Request

CHILD = [sys.executable, "-m", "s2a_bench.inference.smoke"]
"""The command of the child process; its argument is a folder for the dummies."""
LONGEST_S = 600.0
TOKENS = 6
CUDA_BUILD = (
    "make setup CUDA=1, or CMAKE_ARGS=-DGGML_CUDA=on pip install --no-binary llama-cpp-python --force-reinstall "
    "--no-cache-dir llama-cpp-python"
)
AMX_BUILD = "CC=gcc-14 CXX=g++-14 make clean setup, with GCC 13.3 or newer or clang"
BUILT_FOR = f"{sys.prefix}/s2a-bench-llama".lstrip("/")
"""The file in which `make setup` notes the processor features of its build."""


class Smoke(NamedTuple):
    """The child's return code, and one line with the way out unless that is 0."""

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
            return Smoke(1, f"llama.cpp gave no answer within {LONGEST_S:.0f} s; stop other programs, and try again")
    if not done.returncode:
        return Smoke(0)
    quant = (done.stdout.split() or ["no"])[-1]
    how = how_it_ended(done.returncode)
    lines = done.stderr.strip().splitlines() if done.returncode > 0 else []
    return Smoke(done.returncode, ": ".join([f"llama.cpp failed its test with {quant} weights", how, *lines[-1:]]))


def answer(folder: Path) -> None:
    """Let a dummy of every type answer about a picture; print each type first, as the process may die."""
    from s2a_bench.inference.llama_cpp import LlamaCppEngine

    frame = Frame(0, 0, 64, 48, "rgb8", np.zeros((48, 64, 3), np.uint8))
    for quant in get_args(Quant):
        print(quant, flush=True)  # noqa: T201 - the parent reads it
        model, mmproj = write_dummy(folder, "tiny", quant)
        engine = LlamaCppEngine(EngineConfig(model=model, mmproj=mmproj, threads=2))
        count = sum(1 for _ in engine.generate(Request("smoke", "stop at the red line", (frame,), TOKENS)))
        engine.close()
        if count != TOKENS:
            raise EngineError(f"{count} tokens instead of {TOKENS}")


def llama_build(machine: Machine) -> Finding | None:
    """Report the features of llama-cpp-python's build, unused ones of this machine, and whether it works."""
    if not machine.finds("llama_cpp"):
        return None
    if message := smoke_test().message:
        return Finding("llama-build", "error", message, "make clean setup")
    llama_cpp = extras.require("llama_cpp", "llama")
    from s2a_bench.inference.llama_log import silence

    silence()
    llama_cpp.llama_backend_init()
    text = llama_cpp.llama_print_system_info().decode(errors="replace")
    flags = re.findall(r"(\w+) = 1\b", text)
    offload = bool(llama_cpp.llama_supports_gpu_offload())
    cpuinfo = machine.read("proc/cpuinfo") or ""
    amx = _amx(machine, cpuinfo, flags)
    gpu = "with" if offload else "without"
    build = f"llama-cpp-python {llama_cpp.__version__}, {gpu} GPU; {' '.join(flags)}; {amx}"
    if has_nvidia(machine) and not offload:
        return Finding("llama-build", "warning", f"{build}: the NVIDIA GPU of this machine is not used", CUDA_BUILD)
    if platform.machine() == "x86_64" and " avx2" in cpuinfo and "AVX2" not in flags:
        slow = f"{build}: built without this CPU's AVX2, far slower"
        return Finding("llama-build", "warning", slow, "make clean setup")
    if amx.startswith("AMX off"):
        return Finding("llama-build", "advice", build, AMX_BUILD)
    return Finding("llama-build", "state", build)


def _amx(machine: Machine, cpuinfo: str, flags: list[str]) -> str:
    if " amx_tile" not in cpuinfo:
        return "no AMX in this CPU"
    if "AMX_INT8" in flags:
        return "AMX used"
    wrong = (machine.read(BUILT_FOR) or "").endswith("no-amx")
    return "AMX off, as the compiler's code for it does not work" if wrong else "AMX off, left out of this build"


def main() -> int:
    """Run the test; with a folder as argument, as its child."""
    if len(sys.argv) > 1:
        answer(Path(sys.argv[1]))
        return 0
    code, message = smoke_test()
    if message:
        print(message, file=sys.stderr)  # noqa: T201 - for `make setup` and for shells
    return 128 - code if code < 0 else code


if __name__ == "__main__":
    sys.exit(main())
