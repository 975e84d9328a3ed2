"""Checks of Python, packages and compiler."""

from __future__ import annotations

import platform
import re
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from s2a_bench import __version__, extras
from s2a_bench.machine.doctor import Finding, Machine


def python(machine: Machine) -> Finding:
    release = re.search(r'^PRETTY_NAME="?([^"\n]+)', machine.read("etc/os-release") or "", re.MULTILINE)
    system = f"{release[1]}, " if release else ""
    message = f"s2a-bench {__version__}, Python {platform.python_version()} on {platform.machine()}"
    return Finding("python", "state", f"{message}; {system}Linux {platform.release()}")


def packages(machine: Machine) -> Finding:  # noqa: ARG001 - the packages of this interpreter
    try:
        stated = [Requirement(text) for text in requires("s2a-bench") or ()]
    except PackageNotFoundError:
        stated = []
    needed = [each for each in stated if _applies(each)]
    missing, purposes = [], extras.purposes()
    for extra in purposes:
        added = [each for each in stated if _applies(each, extra) and not _applies(each)]
        if all(installed(each.name) for each in added):
            needed += added
        else:
            missing.append(extra)
    if wrong := [problem for each in needed if (problem := _problem(each))]:
        return Finding("packages", "error", "; ".join(wrong), "make setup")
    message = f"{len(needed)} requirements, all met"
    if not missing:
        return Finding("packages", "state", message)
    message += "; without the extras " + ", ".join(f"{extra} ({purposes[extra]})" for extra in missing)
    return Finding("packages", "state", message, extras.how_to_install(*missing))


def _applies(requirement: Requirement, extra: str = "") -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _problem(requirement: Requirement) -> str:
    if not (release := installed(requirement.name)):
        return f"{requirement.name} is missing"
    fits = requirement.specifier.contains(release, prereleases=True)
    return "" if fits else f"{requirement.name} is {release}, not {requirement.specifier}"


def compiler(machine: Machine) -> Finding:
    name = next((name for name in ("c++", "g++", "clang++") if machine.which(name)), None)
    if name is None:
        message = "no C++ compiler: fine while llama-cpp-python stays as it is installed"
        return Finding("compiler", "advice", message, "sudo apt install build-essential")
    first = (machine.run([name, "--version"]) or name).splitlines()[0]
    cuda = re.search(r"release ([\d.]+)", machine.run(["nvcc", "--version"]) or "") if machine.which("nvcc") else None
    return Finding("compiler", "state", first + (f"; CUDA {cuda[1]}" if cuda else "; no nvcc"))
