"""Check that every supported platform can install the dependencies from wheels, with the pins of its constraints file.

pip resolves them as a dry run, once for each of `TARGETS`; nothing is installed. Fails when a requirement has no
candidate, and when a package is resolved that the file does not pin there. llama-cpp-python is compiled, so it
is left out and the packages it needs are resolved in its place; the pure Python packages of `NO_WHEEL` are made into
wheels first. ``python tools/check_platforms.py [--offline-ok]``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = "constraints.txt"
OURS = "s2a-bench"
COMPILED = "llama-cpp-python"
NO_WHEEL = ("empy",)
"""Published as source only; its wheel is pure Python, so that one is built here. colcon-core needs it."""
PROBE = "rosbags"
OFFLINE = 3
"""The exit code where no index answers and ``--offline-ok`` is not given."""
TAIL = 12

AS_TARGET = """
import json, sys
from pip._vendor.packaging import markers
here, target = markers.default_environment, json.loads(sys.argv.pop(1))
markers.default_environment = lambda: {**here(), **target}
for name, value in target.items():
    if not markers.Marker(f"{name} == '{value}'").evaluate():
        sys.exit(f"this pip judges the marker {name} in a way that tools/check_platforms.py does not know")
from pip._internal.cli.main import main
sys.exit(main())
"""
"""Runs pip with the target's environment markers: ``--platform`` and ``--python-version`` choose wheels only, while pip
judges markers, those of dependencies' dependencies too, by the interpreter that it runs in."""


@dataclass(frozen=True, slots=True)
class Target:
    """A platform; ``glibc`` is the minor version of the oldest system with it that is meant."""

    python: str
    machine: str
    glibc: int
    system: str
    extras: tuple[str, ...] = ()
    constraints: str = CONSTRAINTS

    def __str__(self) -> str:
        return f"Python {self.python} on {self.machine} ({self.system}), {self.constraints}"

    def pinned(self) -> str:
        """Return the text of the constraints."""
        return (ROOT / self.constraints).read_text()

    def markers(self) -> dict[str, str]:
        """Return the environment markers of PEP 508 that differ between targets."""
        return {
            "python_version": self.python,
            "python_full_version": f"{self.python}.0",
            "implementation_version": f"{self.python}.0",
            "platform_machine": self.machine,
        }

    def wheels(self) -> list[str]:
        """Return pip's flags for the wheels that this platform takes."""
        tags = [f"manylinux_2_{minor}_{self.machine}" for minor in range(self.glibc, 4, -1)]
        tags.append(f"manylinux2014_{self.machine}")
        if self.machine == "x86_64":
            tags += ["manylinux2010_x86_64", "manylinux1_x86_64"]
        flags = ["--only-binary=:all:", "--implementation", "cp", "--python-version", self.python]
        return flags + [word for tag in tags for word in ("--platform", tag)]


BOARD = ("llama", "ccrb", "nvidia", "act", "ray")
TARGETS = (
    Target("3.10", "x86_64", 35, "Ubuntu 22.04, Humble", ("dev", "ray")),
    Target("3.11", "x86_64", 36, "Debian 12", ("dev", "ray")),
    Target("3.12", "x86_64", 39, "Ubuntu 24.04, Jazzy", ("dev", "ray")),
    Target("3.14", "x86_64", 39, "Ubuntu 26.04, base install"),
    Target("3.10", "aarch64", 35, "JetPack 6", BOARD),
    Target("3.12", "aarch64", 39, "Jazzy in a container", BOARD),
    Target("3.10", "x86_64", 35, "inside Humble", ("llama",), "constraints-ros-humble.txt"),
    Target("3.12", "x86_64", 39, "inside Jazzy", ("llama",), "constraints-ros-jazzy.txt"),
    Target("3.12", "aarch64", 39, "inside Jazzy", ("llama",), "constraints-ros-jazzy.txt"),
)


def requirements(target: Target) -> list[str]:
    """List what pyproject.toml asks for on a platform, and what the compiled package needs in its place."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [Requirement(text) for text in project["dependencies"]]
    requirements += added(project["optional-dependencies"], target.extras)
    try:
        needed = [Requirement(text) for text in requires(COMPILED) or ()]
    except PackageNotFoundError:
        raise SystemExit(f"check-platforms: {COMPILED} is not installed here; run `make setup` first") from None
    requirements = [requirement for requirement in requirements if requirement.name != COMPILED] + needed
    environment = {**target.markers(), "extra": ""}
    wanted = [each for each in requirements if not each.marker or each.marker.evaluate(environment)]
    for requirement in wanted:
        requirement.marker = None
    return [str(requirement) for requirement in wanted]


def added(offered: dict[str, list[str]], names: Iterable[str]) -> Iterator[Requirement]:
    """Yield what extras add to the core, those that an extra takes from another included."""
    for name in names:
        for requirement in map(Requirement, offered[name]):
            if requirement.name == OURS:
                yield from added(offered, sorted(requirement.extras))
            else:
                yield requirement


def pins(target: Target, text: str) -> dict[str, str]:
    """Read which version of each package the constraints ask for on a platform."""
    found = {}
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            pin = Requirement(line)
            if not pin.marker or pin.marker.evaluate(target.markers()):
                found[canonicalize_name(pin.name)] = str(pin.specifier).removeprefix("==")
    return found


def resolve(target: Target, wheels: str) -> list[str]:
    """Let pip resolve a platform, with a folder of more wheels; return what is wrong, nothing if all is well."""
    with TemporaryDirectory() as folder:
        constraints, report = Path(folder) / "constraints.txt", Path(folder) / "report.json"
        constraints.write_text(target.pinned())
        command = [sys.executable, "-c", AS_TARGET, json.dumps(target.markers()), "install", "--dry-run"]
        command += ["--ignore-installed", "--no-input", "--disable-pip-version-check", "--target", folder]
        command += ["--report", str(report), "-c", str(constraints), "--find-links", wheels]
        command += [*target.wheels(), *requirements(target)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own interpreter
        if done.returncode:
            return reasons(done.stdout + done.stderr)
        return unpinned(target, json.loads(report.read_text()), target.pinned())


def reasons(output: str) -> list[str]:
    """Pick out of pip's output the conflict or the missing candidate."""
    lines = [line for line in output.splitlines() if line.strip() and not line.startswith(("WARNING", "[notice]"))]
    first = next((place for place, line in enumerate(lines) if line.startswith(("ERROR", "The conflict"))), -TAIL)
    return lines[first:][:TAIL] or ["pip failed and said nothing"]


def unpinned(target: Target, report: dict[str, list[dict[str, dict[str, str]]]], constraints: str) -> list[str]:
    """Compare what pip's report would install with the pins."""
    pinned = pins(target, constraints)
    found = {canonicalize_name(item["metadata"]["name"]): item["metadata"]["version"] for item in report["install"]}
    return [
        f"{name}=={version} is not pinned here: add it to {target.constraints}"
        for name, version in sorted(found.items())
        if pinned.get(name) != version
    ]


def has_index() -> bool:
    """Tell whether a whole package index answers: a folder of some wheels would not have this one by chance."""
    with TemporaryDirectory() as folder:
        return pip("download", "--only-binary=:all:", "--retries", "1", "--dest", folder, PROBE).returncode == 0


def make_wheels(folder: str) -> None:
    """Make wheels of what is published as source only, of the pinned version."""
    wanted = [line for line in (ROOT / CONSTRAINTS).read_text().splitlines() if line.partition("==")[0] in NO_WHEEL]
    done = pip("wheel", "--wheel-dir", folder, *wanted)
    if done.returncode:
        raise SystemExit("\n".join(reasons(done.stdout + done.stderr)))


def pip(verb: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run pip as it is, on one package without its dependencies."""
    command = [sys.executable, "-m", "pip", verb, "--quiet", "--no-deps", "--no-input", "--disable-pip-version-check"]
    return subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)  # noqa: S603 - our own


def main(arguments: list[str]) -> int:
    """Check all platforms, as many at a time as there are CPUs, and say how each one went."""
    if not has_index():
        print("check-platforms: no package index can be reached from here; nothing was checked", file=sys.stderr)
        return 0 if "--offline-ok" in arguments else OFFLINE
    failed = False
    with TemporaryDirectory() as wheels, ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        make_wheels(wheels)
        for target, wrong in zip(TARGETS, pool.map(resolve, TARGETS, repeat(wheels)), strict=False):
            print(f"{'FAILED' if wrong else 'ok':6} {target}", flush=True)
            for line in wrong:
                print(f"       {line}")
            failed = failed or bool(wrong)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
