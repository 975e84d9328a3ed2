"""Python, packages, compiler, and how llama.cpp was built."""

from __future__ import annotations

import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from s2a_bench import __version__, extras
from s2a_bench.machine.doctor import Finding, Machine

CUDA_BUILD = (
    "make setup CUDA=1, or CMAKE_ARGS=-DGGML_CUDA=on pip install --no-binary llama-cpp-python --force-reinstall"
)
CUDA_BUILD += " --no-cache-dir llama-cpp-python"
AMX_BUILD = "CC=gcc-14 CXX=g++-14 make clean setup, with GCC 13.3 or newer or clang"
BUILT_FOR = f"{sys.prefix}/s2a-bench-llama".lstrip("/")
"""Where `make setup` notes what it built llama-cpp-python for."""


def python(machine: Machine) -> Finding:
    """Name the interpreter and the platform."""
    release = re.search(r'^PRETTY_NAME="?([^"\n]+)', machine.read("etc/os-release") or "", re.MULTILINE)
    system = f"{release[1]}, " if release else ""
    told = f"s2a-bench {__version__}, Python {platform.python_version()} on {platform.machine()}"
    return Finding("python", "state", f"{told}; {system}Linux {platform.release()}")


def packages(machine: Machine) -> Finding:  # noqa: ARG001 - the packages of this interpreter
    """Compare the packages that are installed with those that are needed here, and say which extras are there."""
    try:
        stated = [Requirement(text) for text in requires("s2a-bench") or ()]
    except PackageNotFoundError:
        stated = []
    needed = [each for each in stated if _applies(each)]
    missing = []
    for extra in extras.EXTRAS:
        added = [each for each in stated if _applies(each, extra) and not _applies(each)]
        if all(_installed(each.name) for each in added):
            needed += added
        else:
            missing.append(extra)
    if wrong := [problem for each in needed if (problem := _problem(each))]:
        return Finding("packages", "error", "; ".join(wrong), "make setup")
    message = f"{len(needed)} requirements, all met"
    if not missing:
        return Finding("packages", "state", message)
    without = ", ".join(f"{extra} ({extras.EXTRAS[extra]})" for extra in missing)
    return Finding("packages", "state", f"{message}; without the extras {without}", extras.how_to_install(*missing))


def _applies(requirement: Requirement, extra: str = "") -> bool:
    """Whether a package is needed on this platform with an extra, or with none."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _installed(package: str) -> str:
    """Return a package's version; "" where it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _problem(requirement: Requirement) -> str:
    """Return what is wrong with a package that is needed, "" if nothing is."""
    found = _installed(requirement.name)
    if not found:
        return f"{requirement.name} is missing"
    fits = requirement.specifier.contains(found, prereleases=True)
    return "" if fits else f"{requirement.name} is {found}, not {requirement.specifier}"


def compiler(machine: Machine) -> Finding:
    """Find what llama-cpp-python is compiled with."""
    name = next((name for name in ("c++", "g++", "clang++") if machine.which(name)), None)
    if name is None:
        return Finding(
            "compiler",
            "advice",
            "no C++ compiler: fine while llama-cpp-python stays as it is installed",
            "sudo apt install build-essential",
        )
    first = (machine.run([name, "--version"]) or name).splitlines()[0]
    cuda = re.search(r"release ([\d.]+)", machine.run(["nvcc", "--version"]) or "") if machine.which("nvcc") else None
    return Finding("compiler", "state", first + (f"; CUDA {cuda[1]}" if cuda else "; no nvcc"))


def llama_build(machine: Machine) -> Finding | None:
    """Say what llama-cpp-python was built for, whether GPU or AMX lie idle because of it, and whether it works."""
    from s2a_bench.machine.doctor.gpu import has_nvidia

    if not machine.finds("llama_cpp"):
        return None
    seen = machine.smoke_test()
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
    """Say whether this CPU has AMX and llama.cpp uses it."""
    if " amx_tile" not in cpuinfo:
        return "no AMX in this CPU"
    if "AMX_INT8" in flags:
        return "AMX used"
    wrong = (machine.read(BUILT_FOR) or "").endswith("no-amx")
    return "AMX off, as the compiler's code for it does not work" if wrong else "AMX off, left out of this build"
