"""Set up `.venv` from nothing: check what is needed, compile llama-cpp-python once, install the rest.

Standard library only, because it runs before anything is installed: ``python3 tools/setup.py``. Does nothing when
the installation is up to date; prints what it does, and one clear line for what is missing. ``core`` behind it installs
only what measures transports, from wheels: numbers come first, the compiler later.

``S2A_BENCH_CUDA=1`` (`make setup CUDA=1`) builds llama-cpp-python for an NVIDIA GPU, ``0`` for the CPU; without it the
build stays what it is, so that a later `make test` does not undo it. The same holds for AMX, the matrix unit of some
x86 CPUs, which is left out of the build where the compiler's code for it does not work.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = Path(os.environ.get("S2A_BENCH_VENV", ROOT / ".venv"))
PYTHON = VENV / "bin" / "python"
CONSTRAINTS = ROOT / "constraints.txt"
LOG = VENV / "setup.log"
BUILD = VENV / "s2a-bench-llama"
"""Says what llama-cpp-python was built for: cpu or cuda, then, on a CPU with AMX, amx or no-amx; without it, cpu.

`broken` behind it: the build died in its test."""
CPUINFO = Path("/proc/cpuinfo")
AMX_PROBE = ROOT / "tools" / "amx_probe.cpp"
NO_AMX = ("-mno-amx-tile", "-mno-amx-int8", "-mno-amx-bf16")
OLDEST = (3, 10)
NINJA_STEP = re.compile(r"\[(\d+)/(\d+)\]")
TAIL = 15
DIED = 128
"""An exit code above it says that the test was killed by a signal, as in a shell."""
CUDA_COMPILERS = ("nvcc", "/usr/local/cuda/bin/nvcc")
"""Where CUDA's compiler is: in PATH, or where NVIDIA installs it."""


class SetupError(Exception):
    """Something is missing; the message is the one line for the user."""


def check_python() -> None:
    """Fail before anything is downloaded if this Python cannot make the environment."""
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


def check_compilers() -> None:
    """Fail before anything is compiled if that cannot succeed."""
    if built_for() != wanted_build() and not compiler():
        raise SetupError(
            "no C++ compiler found, and llama-cpp-python has to be compiled: sudo apt install build-essential "
            "(or set CC and CXX)"
        )
    if built_for() != wanted_build() and wanted_build().startswith("cuda") and not cuda_compiler():
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


def processor() -> str:
    """Return the CPU's instruction sets as the kernel lists them, on x86 and on Arm."""
    listed = re.search(r"^(?:flags|Features)\s*:(.*)", CPUINFO.read_text(), re.MULTILINE) if CPUINFO.exists() else None
    return listed[1].strip() if listed else ""


@functools.cache
def amx() -> str:
    """Return amx or no-amx: whether the compiler's code for this CPU's AMX works; "" where either knows none.

    GCC bug 114098: `_tile_loadconfig` promises the optimiser to read 8 of the configuration's 64 bytes, so that the
    stores to the others are dropped, and the first load of a tile is an illegal instruction.
    """
    found = compiler()
    if "amx_tile" not in processor().split() or found is None:
        return ""
    with tempfile.TemporaryDirectory() as folder:
        probe = str(Path(folder) / "probe")
        command = [*found.split(), "-O2", "-o", probe, str(AMX_PROBE)]
        if not succeeds(*command, *NO_AMX, "-DNOTHING"):
            return ""
        return "amx" if succeeds(*command, "-mamx-tile") and succeeds(probe) else "no-amx"


def succeeds(*command: str) -> bool:
    """Run a program quietly; return whether it ends with 0."""
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0  # noqa: S603 - our own
    except OSError:
        return False


def has_pip() -> bool:
    """Tell whether the environment is whole: one whose making was interrupted has no pip."""
    return succeeds(str(PYTHON), "-m", "pip", "--version")


def built_for() -> str:
    """Return what llama-cpp-python of the pinned version was built for, see `BUILD`; "" if it is not there."""
    wanted = requirement("llama-cpp-python").partition("==")[2]
    if not any(VENV.glob(f"lib/python*/site-packages/llama_cpp_python-{wanted}.dist-info")):
        return ""
    return BUILD.read_text() if BUILD.exists() else "cpu"


def wanted_build() -> str:
    """Return what llama-cpp-python should be built for: the user's last choice, and the one check of AMX.

    On a CPU with AMX a build that says nothing of it, or that broke, is made again.
    """
    wanted = os.environ.get("S2A_BENCH_CUDA", "")
    if wanted not in {"", "0", "1"}:
        raise SetupError(f"CUDA={wanted}: should be 1 (build for an NVIDIA GPU) or 0 (for the CPU)")
    built = built_for()
    kind = {"": built.partition(" ")[0] or "cpu", "0": "cpu", "1": "cuda"}[wanted]
    return built if built in {f"{kind} amx", f"{kind} no-amx"} else f"{kind} {amx()}".strip()


def build_llama() -> None:
    """Compile llama-cpp-python and note what for; a build for another processor is not taken from pip's cache."""
    build = wanted_build()
    kind = build.partition(" ")[0]
    flags = ["-v"]
    if built_for() or build != "cpu":
        flags += ["--force-reinstall", "--no-deps", *cache_for(build), "--no-binary", "llama-cpp-python"]
    environment = dict(os.environ)
    if kind == "cuda":
        environment["CMAKE_ARGS"] = f"{os.environ.get('CMAKE_ARGS', '')} -DGGML_CUDA=on".strip()
        environment["CUDACXX"] = str(cuda_compiler())
    if build.endswith("no-amx"):
        for name in ("CFLAGS", "CXXFLAGS"):
            environment[name] = f"{os.environ.get(name, '')} {' '.join(NO_AMX)}".strip()
        print(
            f"this CPU's AMX stays unused, as code that {compiler()} makes for it fails here (GCC bug 114098); GCC "
            "13.3 or newer and clang would use it: CC=gcc-14 CXX=g++-14 make clean setup",
            flush=True,
        )
    takes = {"cpu": "for this machine in 5 to 10 minutes", "cuda": "for this machine's GPU, which takes long"}[kind]
    print(f"installing llama-cpp-python: compiled {takes}, once", flush=True)
    BUILD.unlink(missing_ok=True)
    pip(*flags, requirement("llama-cpp-python"), watch=True, environment=environment)
    BUILD.write_text(build)


def cache_for(build: str) -> list[str]:
    """Return pip's option for where this build is kept for the next environment, if anywhere.

    pip knows its wheels by name and version, not by how they were compiled. So each verdict on AMX has a folder of
    its own, and what is for one GPU, or follows a build that broke, is not kept.
    """
    kind, _, verdict = build.partition(" ")
    wanted = [str(PYTHON), "-m", "pip", "cache", "dir"]
    if kind == "cpu" and verdict and not built_for().endswith("broken"):
        done = subprocess.run(wanted, capture_output=True, text=True, check=False)  # noqa: S603 - our own interpreter
        if done.returncode == 0 and done.stdout.strip():  # fails where the user has switched the cache off
            return ["--cache-dir", str(Path(done.stdout.strip()) / f"s2a-bench-{verdict}")]
    return ["--no-cache-dir"]


def try_llama() -> None:
    """Let llama.cpp answer about a picture in a process of its own; raises SetupError where it cannot.

    A build that dies is marked, so that the next set-up compiles it anew.
    """
    if built_for().startswith("cuda") and not has_driver():
        print("llama.cpp is not tried: the GPU's driver is not here", flush=True)
        return
    command = [str(PYTHON), "-m", "s2a_bench.inference.smoke"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode > DIED:
        BUILD.write_text(f"{built_for().partition(' ')[0]} broken")
    if done.returncode:
        raise SetupError((done.stderr.strip() or f"llama.cpp's test ended with {done.returncode}").splitlines()[-1])


def has_driver() -> bool:
    """Return whether CUDA's driver can be loaded, without which a CUDA build cannot: not in a container build."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


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


def make_environment() -> None:
    """Make the environment where there is none that is whole, with an empty log."""
    check_python()
    if not has_pip():
        print(f"making {VENV}", flush=True)
        venv = [sys.executable, "-m", "venv", "--clear", str(VENV)]
        if subprocess.run(venv, check=False).returncode:  # noqa: S603 - our own interpreter
            raise SetupError(f"cannot make a virtual environment in {VENV}; is the folder writable?")
    LOG.write_text("")


def install_core() -> None:
    """Make the environment and install what needs no compiler; say how long a newcomer waited for that."""
    started = time.monotonic()
    make_environment()
    print("installing the packages that measure transports, from wheels", flush=True)
    pip("--quiet", "--editable", str(ROOT))
    print(f"ready to measure transports after {time.monotonic() - started:.0f} s", flush=True)


def install() -> None:
    """Make the environment, compile llama-cpp-python, install the rest (`dev` has all but Ray)."""
    check_compilers()
    make_environment()
    if built_for() != wanted_build():
        build_llama()
    print("installing the other packages", flush=True)
    pip("--quiet", "--editable", f"{ROOT}[dev]")


def main(*wanted: str) -> int:
    """Bring `.venv` up to date, and see that llama.cpp works on this processor; with ``core`` its first part alone."""
    stamp, core = VENV / "s2a-bench-installed", VENV / "s2a-bench-core"
    installed, _, tried_on = stamp.read_text().partition("\n") if stamp.exists() else ("", "", "")
    try:
        if wanted == ("core",):
            done = installed or (core.read_text() if core.exists() else "")
            if done != fingerprint() or not PYTHON.exists():
                install_core()
                core.write_text(fingerprint())
            return 0
        if installed != fingerprint() or not PYTHON.exists() or built_for() != wanted_build():
            install()
        elif tried_on == processor():
            return 0
        stamp.unlink(missing_ok=True)
        try_llama()
        stamp.write_text(f"{fingerprint()}\n{processor()}")
    except SetupError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("setup: interrupted; run it again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
