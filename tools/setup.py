"""Set up `.venv` from nothing: check what is needed, compile llama-cpp-python once, install the rest.

Standard library only, because it runs before anything is installed: ``python3 tools/setup.py``. Does nothing when
the installation is up to date; prints what it does, and one clear line for what is missing.

``S2A_BENCH_CUDA=1`` (`make setup CUDA=1`) builds llama-cpp-python for an NVIDIA GPU, ``0`` for the CPU; without it the
build stays what it is, so that a later `make test` does not undo it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = Path(os.environ.get("S2A_BENCH_VENV", ROOT / ".venv"))
PYTHON = VENV / "bin" / "python"
CONSTRAINTS = ROOT / "constraints.txt"
LOG = VENV / "setup.log"
BUILD = VENV / "s2a-bench-llama"
"""Says what llama-cpp-python was built for, cpu or cuda; without it, cpu."""
OLDEST = (3, 10)
NINJA_STEP = re.compile(r"\[(\d+)/(\d+)\]")
TAIL = 15
CUDA_COMPILERS = ("nvcc", "/usr/local/cuda/bin/nvcc")
"""Where CUDA's compiler is: in PATH, or where NVIDIA installs it."""


class SetupError(Exception):
    """Something is missing; the message is the one line that the user sees."""


def check_machine() -> None:
    """Fail before anything is downloaded if the rest cannot succeed."""
    if sys.version_info < OLDEST:
        found = ".".join(map(str, sys.version_info[:3]))
        raise SetupError(f"Python {found} is too old: run `make PYTHON=python3.10` or newer")
    if sys.platform != "linux":
        raise SetupError(f"s2a-bench runs on Linux, not on {sys.platform}")
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        name = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
        raise SetupError(f"this Python cannot make virtual environments ({error}): sudo apt install {name}") from error
    if built_for() != wanted_build() and not compiler():
        raise SetupError(
            "no C++ compiler found, and llama-cpp-python has to be compiled: sudo apt install build-essential "
            "(or set CC and CXX)"
        )
    if built_for() != wanted_build() == "cuda" and not cuda_compiler():
        raise SetupError(
            "CUDA=1 needs nvcc, CUDA's compiler: sudo apt install nvidia-cuda-toolkit (on a Jetson: nvidia-jetpack), "
            "or name it in CUDACXX"
        )


def compiler() -> str | None:
    """Find the C++ compiler that CMake would take; it needs a C compiler too."""
    cc = os.environ.get("CC") or "cc"
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    if not (shutil.which(cc.split()[0]) or shutil.which("gcc") or shutil.which("clang")):
        return None
    return next((name for name in names if shutil.which(name.split()[0])), None)


def cuda_compiler() -> str | None:
    """Find CUDA's compiler."""
    names = (os.environ["CUDACXX"],) if os.environ.get("CUDACXX") else CUDA_COMPILERS
    return next((found for name in names if (found := shutil.which(name))), None)


def has_pip() -> bool:
    """Tell whether the environment is whole: one whose making was interrupted has no pip."""
    try:
        probe = [str(PYTHON), "-m", "pip", "--version"]
        return subprocess.run(probe, capture_output=True, check=False).returncode == 0  # noqa: S603
    except OSError:
        return False


def built_for() -> str:
    """Return what llama-cpp-python of the pinned version was built for, cpu or cuda; "" if it is not there."""
    wanted = requirement("llama-cpp-python").partition("==")[2]
    if not any(VENV.glob(f"lib/python*/site-packages/llama_cpp_python-{wanted}.dist-info")):
        return ""
    return BUILD.read_text() if BUILD.exists() else "cpu"


def wanted_build() -> str:
    """Return what llama-cpp-python should be built for: what the user said last."""
    asked = os.environ.get("S2A_BENCH_CUDA", "")
    if asked not in {"", "0", "1"}:
        raise SetupError(f"CUDA={asked}: should be 1 (build for an NVIDIA GPU) or 0 (for the CPU)")
    if not asked:
        return built_for() or "cpu"
    return "cuda" if asked == "1" else "cpu"


def build_llama() -> None:
    """Compile llama-cpp-python and note what for; a build for another processor is not taken from pip's cache."""
    build = wanted_build()
    flags = ["-v"]
    if built_for() or build == "cuda":
        flags += ["--force-reinstall", "--no-deps", "--no-cache-dir", "--no-binary", "llama-cpp-python"]
    environment = dict(os.environ)
    if build == "cuda":
        environment["CMAKE_ARGS"] = f"{os.environ.get('CMAKE_ARGS', '')} -DGGML_CUDA=on".strip()
        environment["CUDACXX"] = str(cuda_compiler())
    takes = {"cpu": "for this machine in 5 to 10 minutes", "cuda": "for this machine's GPU, which takes long"}[build]
    print(f"installing llama-cpp-python: compiled {takes}, once", flush=True)
    BUILD.unlink(missing_ok=True)
    pip(*flags, requirement("llama-cpp-python"), watch=True, environment=environment)
    BUILD.write_text(build)


def requirement(name: str) -> str:
    """Return the line of constraints.txt that pins ``name``."""
    for line in CONSTRAINTS.read_text().splitlines():
        if line.startswith(name + "=="):
            return line.partition(";")[0].strip()
    raise SetupError(f"{CONSTRAINTS} does not pin {name}")


def fingerprint() -> str:
    """Name the state that an installation was made from."""
    digest = hashlib.sha256(str(ROOT).encode())
    for path in (ROOT / "pyproject.toml", CONSTRAINTS):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def pip(*arguments: str, watch: bool = False, environment: dict[str, str] | None = None) -> None:
    """Run pip with its output in the log; ``watch`` shows ninja's steps as they pass."""
    command = [str(PYTHON), "-m", "pip", "--disable-pip-version-check", "install", "-c", str(CONSTRAINTS), *arguments]
    with (
        LOG.open("a") as log,
        subprocess.Popen(  # noqa: S603 - our own interpreter
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", env=environment
        ) as process,
    ):
        assert process.stdout is not None  # noqa: S101 - opened as a pipe
        shown = -1.0
        started = time.monotonic()
        for line in process.stdout:
            log.write(line)
            step = NINJA_STEP.search(line) if watch else None
            if step:
                done, total = int(step[1]), int(step[2])
                elapsed = time.monotonic() - started
                if done / total - shown >= 0.1 or (sys.stdout.isatty() and done / total > shown):  # noqa: PLR2004
                    shown = done / total
                    left = elapsed / done * (total - done)
                    end = "\r" if sys.stdout.isatty() and done < total else "\n"
                    print(f"  compiling: {done:3d} of {total}, about {left:3.0f} s left ", end=end, flush=True)
    if process.returncode:
        tail = "".join(LOG.read_text(errors="replace").splitlines(keepends=True)[-TAIL:])
        raise SetupError(f"{tail}\npip failed; the whole log is {LOG}")


def main() -> int:
    """Bring `.venv` up to date."""
    stamp = VENV / "s2a-bench-installed"
    try:
        up_to_date = stamp.exists() and stamp.read_text() == fingerprint() and PYTHON.exists()
        if up_to_date and built_for() == wanted_build():
            return 0
        check_machine()
        if not has_pip():
            print(f"making {VENV}", flush=True)
            venv = [sys.executable, "-m", "venv", "--clear", str(VENV)]
            if subprocess.run(venv, check=False).returncode:  # noqa: S603 - our own interpreter
                raise SetupError(f"cannot make a virtual environment in {VENV}; is the folder writable?")
        LOG.write_text("")
        if built_for() != wanted_build():
            build_llama()
        print("installing the other packages", flush=True)
        pip("--quiet", "--editable", f"{ROOT}[dev]")
        stamp.write_text(fingerprint())
    except SetupError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("setup: interrupted; run it again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
