"""The set-up script says what is missing before it downloads anything."""

from __future__ import annotations

import importlib.util
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent.parent


def setup(tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "tools" / "setup.py")],
        env={"S2A_BENCH_VENV": str(tmp_path / "venv"), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_a_missing_compiler_is_one_line_at_once(tmp_path: Path) -> None:
    done = setup(tmp_path, PATH=str(tmp_path))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("setup: no C++ compiler found")
    assert "apt install build-essential" in line
    assert not (tmp_path / "venv").exists()


def lines_with(name: str, file: str) -> list[str]:
    return [line.strip().strip('",') for line in (ROOT / file).read_text().splitlines() if name in line]


def test_the_pinned_llama_cpp_is_the_required_one() -> None:
    (pinned,) = lines_with("llama-cpp-python==", "constraints.txt")
    (required,) = lines_with("llama-cpp-python==", "pyproject.toml")
    assert f'"{pinned}"' in required


AMX = "flags\t\t: fpu avx2 amx_bf16 amx_tile amx_int8\n"


def write_program(path: Path, lines: str) -> None:
    path.write_text(f"#!/bin/sh\n{lines}\n")
    path.chmod(0o755)


Calls = list[tuple[tuple[str, ...], dict[str, str]]]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load the script for a virtual environment of its own, with nvcc to be found."""
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    for name in ("nvcc", "c++", "cc"):
        write_program(bin_ / name, "")
    for name, value in {"S2A_BENCH_VENV": str(tmp_path / "venv"), "PATH": str(bin_)}.items():
        monkeypatch.setenv(name, value)
    for name in ("S2A_BENCH_CUDA", "CMAKE_ARGS", "CUDACXX", "CC", "CXX", "CFLAGS", "CXXFLAGS"):
        monkeypatch.delenv(name, raising=False)
    spec = importlib.util.spec_from_file_location("setup_script", ROOT / "tools" / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(module, "has_driver", lambda: True)
    module.CPUINFO.write_text("flags\t\t: fpu avx2\n")
    return module


@pytest.fixture
def calls(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Stand in for pip: record its arguments, and leave what it would install."""
    calls: Calls = []
    version = script.requirement("llama-cpp-python").partition("==")[2]
    python = script.PYTHON

    def pip(*arguments: str, watch: bool = False, environment: dict[str, str] | None = None) -> None:  # noqa: ARG001
        calls.append((arguments, environment or {}))
        site = script.VENV / "lib/python3.11/site-packages" / f"llama_cpp_python-{version}.dist-info"
        site.mkdir(parents=True, exist_ok=True)

    python.parent.mkdir(parents=True)
    write_program(python, f'case "$*" in *cache*) echo {script.VENV.parent / "pip-cache"};; esac')
    monkeypatch.setattr(script, "pip", pip)
    monkeypatch.setattr(script, "has_pip", lambda: True)
    return calls


def built(calls: Calls) -> list[str]:
    """Say what each build of llama.cpp was for, and forget it."""
    kinds = [env.get("CMAKE_ARGS", "cpu") for arguments, env in calls if arguments[0] == "-v"]
    calls.clear()
    return kinds


def test_cuda_is_built_once_kept_and_undone_only_when_asked(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert script.main() == 0
    assert built(calls) == ["cpu"]
    assert script.main() == 0
    assert calls == []
    monkeypatch.setenv("S2A_BENCH_CUDA", "1")
    assert script.main() == 0
    (arguments, environment), *_ = calls
    assert {"--force-reinstall", "--no-cache-dir", "--no-deps"} <= set(arguments)  # no CPU wheel from the cache
    assert environment["CUDACXX"].endswith("/bin/nvcc")
    assert built(calls) == ["-DGGML_CUDA=on"]
    monkeypatch.setenv("S2A_BENCH_CUDA", "")  # as `make test` after `make setup CUDA=1`
    assert script.main() == 0
    assert calls == []
    monkeypatch.setenv("S2A_BENCH_CUDA", "0")
    assert script.main() == 0
    assert built(calls) == ["cpu"]
    assert script.built_for() == "cpu"


def test_the_users_cmake_arguments_stay(script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CMAKE_ARGS", "-DCMAKE_CUDA_ARCHITECTURES=87")
    monkeypatch.setenv("S2A_BENCH_CUDA", "1")
    assert script.main() == 0
    assert built(calls) == ["-DCMAKE_CUDA_ARCHITECTURES=87 -DGGML_CUDA=on"]


def test_a_build_that_broke_off_is_made_again(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("S2A_BENCH_CUDA", "1")
    whole = script.pip

    def breaks(*arguments: str, **settings: object) -> None:  # noqa: ARG001
        raise script.SetupError("pip failed")

    monkeypatch.setattr(script, "pip", breaks)
    assert script.main() == 1
    monkeypatch.setattr(script, "pip", whole)
    assert script.main() == 0
    assert built(calls) == ["-DGGML_CUDA=on"]


def test_without_nvcc_cuda_is_one_line_before_anything_is_compiled(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("S2A_BENCH_CUDA", "1")
    monkeypatch.setattr(script, "amx", lambda: "no-amx")
    monkeypatch.setattr(script, "CUDA_COMPILERS", ("no-such-nvcc",))
    assert script.main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("setup: CUDA=1 needs nvcc")
    assert "nvidia-cuda-toolkit" in line
    assert calls == []


def test_a_cuda_setting_that_is_none_is_named(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("S2A_BENCH_CUDA", "yes")
    assert script.main() == 1
    assert capsys.readouterr().err == "setup: CUDA=yes: should be 1 (build for an NVIDIA GPU) or 0 (for the CPU)\n"


def compile_as(script: ModuleType, *, probe: str, flags: str = "") -> None:
    """Let the CPU have AMX and a stand-in compile the probe into ``probe``; ``flags`` is what it knows besides."""
    script.CPUINFO.write_text(AMX)
    lines = f"""
case "$*" in *-mno-amx*) {flags or "exit 0"};; esac
while [ "$1" != -o ]; do shift; done
printf '#!/bin/sh\\n{probe}\\n' > "$2"
/bin/chmod +x "$2"
"""
    write_program(script.VENV.parent / "bin" / "c++", lines)


SOUND, WRONG_BYTES, DIES = "exit 0", "exit 1", "kill -ILL $$"


@pytest.mark.parametrize(
    ("probe", "flags", "verdict"),
    [
        (SOUND, "", "amx"),
        (WRONG_BYTES, "", "no-amx"),
        (DIES, "", "no-amx"),
        (SOUND, "exit 1", ""),  # a compiler that does not know AMX makes no use of it, and refuses the flags
    ],
)
def test_the_probe_judges_what_the_compiler_makes_of_amx(
    script: ModuleType, probe: str, flags: str, verdict: str
) -> None:
    compile_as(script, probe=probe, flags=flags)
    assert script.amx() == verdict


def test_without_amx_nothing_is_compiled_to_judge_it(script: ModuleType) -> None:
    compile_as(script, probe=WRONG_BYTES)
    script.CPUINFO.write_text("flags\t\t: fpu avx2\n")
    assert script.amx() == ""
    script.CPUINFO.unlink()
    assert script.amx.__wrapped__() == ""


COMPILER = shutil.which("c++")


@pytest.mark.skipif(platform.machine() != "x86_64" or not COMPILER, reason="needs a C++ compiler for x86-64")
def test_the_probe_itself_is_sound_code(tmp_path: Path) -> None:
    flags = ["-O2", "-mamx-tile", "-Wall", "-Wextra", "-Werror", "-o", str(tmp_path / "probe")]
    subprocess.run([str(COMPILER), *flags, str(ROOT / "tools" / "amx_probe.cpp")], check=True)
    assert subprocess.run([str(tmp_path / "probe")], check=False).returncode in {-4, 0, 1, 2}  # as the CPU has it


def test_a_compiler_that_breaks_amx_builds_without_it_and_says_so_once(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CXXFLAGS", "-g  -O1")
    compile_as(script, probe=WRONG_BYTES)
    assert script.main() == 0
    (arguments, environment), *_ = calls
    off = "-mno-amx-tile -mno-amx-int8 -mno-amx-bf16"
    assert (environment["CFLAGS"], environment["CXXFLAGS"]) == (off, f"-g  -O1 {off}")
    assert arguments[arguments.index("--cache-dir") + 1].endswith("/pip-cache/s2a-bench-no-amx")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "AMX" in line]
    assert "GCC 13.3 or newer and clang would use it: CC=" in line
    assert script.built_for() == "cpu no-amx"
    calls.clear()
    assert script.main() == 0
    assert calls == []


def test_a_sound_compiler_uses_amx_and_has_a_cache_apart(script: ModuleType, calls: Calls) -> None:
    compile_as(script, probe=SOUND)
    assert script.main() == 0
    (arguments, environment), *_ = calls
    assert "CFLAGS" not in environment
    assert arguments[arguments.index("--cache-dir") + 1].endswith("/pip-cache/s2a-bench-amx")
    assert script.built_for() == "cpu amx"
    compile_as(script, probe=WRONG_BYTES)  # a later `make test` with another compiler does not undo it
    script.amx.cache_clear()
    calls.clear()
    assert script.main() == 0
    assert calls == []


def break_llama(script: ModuleType, code: int, *messages: str) -> None:
    lines = "\n".join(f"echo '{line}' >&2" for line in messages)
    write_program(script.PYTHON, f'case "$*" in *smoke*) {lines}\nexit {code};; esac')


def test_a_build_that_dies_is_not_ready_and_is_compiled_anew_next_time(
    script: ModuleType, calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    break_llama(script, 132, "llama.cpp failed its test: killed by signal 4")
    assert script.main() == 1
    assert capsys.readouterr().err == "setup: llama.cpp failed its test: killed by signal 4\n"
    assert not (script.VENV / "s2a-bench-installed").exists()
    calls.clear()
    break_llama(script, 0)
    assert script.main() == 0
    (arguments, _), *_ = calls
    assert {"--force-reinstall", "--no-cache-dir"} <= set(arguments)
    assert script.built_for() == "cpu"
    assert (script.VENV / "s2a-bench-installed").exists()


def test_a_test_that_fails_otherwise_is_not_ready_but_keeps_the_build(
    script: ModuleType, calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    break_llama(script, 1, "a long story", "No space left on device")
    assert script.main() == 1
    assert capsys.readouterr().err == "setup: No space left on device\n"
    assert script.built_for() == "cpu"
    calls.clear()
    break_llama(script, 0)
    assert script.main() == 0
    assert built(calls) == []


def test_another_processor_is_tried_before_it_is_called_ready(
    script: ModuleType, calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main() == 0
    calls.clear()
    script.CPUINFO.write_text("Features\t: fp asimd\n")
    break_llama(script, 132, "died")
    assert script.main() == 1
    assert "died" in capsys.readouterr().err
    assert calls == []


def test_a_gpu_build_without_its_driver_is_not_tried(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("S2A_BENCH_CUDA", "1")
    monkeypatch.setattr(script, "has_driver", lambda: False)
    break_llama(script, 1, "libcuda.so.1: cannot open shared object file")
    assert script.main() == 0
    assert "not tried: the GPU's driver is not here" in capsys.readouterr().out
    assert built(calls) == ["-DGGML_CUDA=on"]


def test_the_core_needs_no_compiler_and_is_installed_once(
    script: ModuleType, calls: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(script, "compiler", lambda: None)
    assert script.main("core") == 0
    assert [arguments for arguments, _ in calls] == [("--quiet", "--editable", str(script.ROOT))]
    assert "ready to measure transports after" in capsys.readouterr().out
    calls.clear()
    assert script.main("core") == 0
    assert calls == []
