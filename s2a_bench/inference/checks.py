"""What the doctor checks of engines: how llama.cpp was built, and whether it answers."""

from __future__ import annotations

import platform
import re
import sys

from s2a_bench import extras
from s2a_bench.inference.smoke import smoke_test
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.machine.doctor.gpu import has_nvidia

CUDA_BUILD = (
    "make setup CUDA=1, or CMAKE_ARGS=-DGGML_CUDA=on pip install --no-binary llama-cpp-python --force-reinstall"
)
CUDA_BUILD += " --no-cache-dir llama-cpp-python"
AMX_BUILD = "CC=gcc-14 CXX=g++-14 make clean setup, with GCC 13.3 or newer or clang"
BUILT_FOR = f"{sys.prefix}/s2a-bench-llama".lstrip("/")
"""Where `make setup` notes what it built llama-cpp-python for."""


def llama_build(machine: Machine) -> Finding | None:
    """Return what llama-cpp-python was built for, whether GPU or AMX lie idle because of it, and whether it works."""
    if not machine.finds("llama_cpp"):
        return None
    seen = smoke_test()
    if seen.message:
        return Finding("llama-build", "error", seen.message, "make clean setup")
    llama_cpp = extras.require("llama_cpp", "llama")
    from s2a_bench.inference.llama_log import silence

    silence()
    llama_cpp.llama_backend_init()
    text = llama_cpp.llama_print_system_info().decode(errors="replace")
    flags = re.findall(r"(\w+) = 1\b", text)
    offload = bool(llama_cpp.llama_supports_gpu_offload())
    cpuinfo = machine.read("proc/cpuinfo") or ""
    amx = _amx(machine, cpuinfo, flags)
    told = f"llama-cpp-python {llama_cpp.__version__}, {'with' if offload else 'without'} GPU; {' '.join(flags)}; {amx}"
    if has_nvidia(machine) and not offload:
        return Finding("llama-build", "warning", f"{told}: the NVIDIA GPU of this machine is not used", CUDA_BUILD)
    if platform.machine() == "x86_64" and " avx2" in cpuinfo and "AVX2" not in flags:
        return Finding(
            "llama-build", "warning", f"{told}: built without this CPU's AVX2, far slower", "make clean setup"
        )
    if amx.startswith("AMX off"):
        return Finding("llama-build", "advice", told, AMX_BUILD)
    return Finding("llama-build", "state", told)


def _amx(machine: Machine, cpuinfo: str, flags: list[str]) -> str:
    """Return whether this CPU has AMX and llama.cpp uses it."""
    if " amx_tile" not in cpuinfo:
        return "no AMX in this CPU"
    if "AMX_INT8" in flags:
        return "AMX used"
    wrong = (machine.read(BUILT_FOR) or "").endswith("no-amx")
    return "AMX off, as the compiler's code for it does not work" if wrong else "AMX off, left out of this build"
