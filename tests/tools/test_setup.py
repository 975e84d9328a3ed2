"""The set-up script says what is missing before it downloads anything."""

from __future__ import annotations

import importlib.util
import os
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


def test_a_compiler_that_the_user_named_but_is_missing_counts_as_none(tmp_path: Path) -> None:
    done = setup(tmp_path, PATH=os.environ["PATH"], CXX="no-such-compiler")
    assert "no C++ compiler found" in done.stderr


def lines_with(name: str, file: str) -> list[str]:
    return [line.strip().strip('",') for line in (ROOT / file).read_text().splitlines() if name in line]


def test_the_pinned_llama_cpp_is_the_required_one() -> None:
    assert lines_with("llama-cpp-python==", "constraints.txt") == lines_with("llama-cpp-python==", "pyproject.toml")


Calls = list[tuple[tuple[str, ...], dict[str, str]]]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load the script for a virtual environment of its own, with nvcc to be found."""
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    for name in ("nvcc", "c++", "cc"):
        (bin_ / name).write_text("#!/bin/sh\n")
        (bin_ / name).chmod(0o755)
    for name, value in {"S2A_BENCH_VENV": str(tmp_path / "venv"), "PATH": str(bin_)}.items():
        monkeypatch.setenv(name, value)
    for name in ("S2A_BENCH_CUDA", "CMAKE_ARGS", "CUDACXX", "CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    spec = importlib.util.spec_from_file_location("setup_script", ROOT / "tools" / "setup.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def calls(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Stand in for pip: note what it is asked for, and leave what it would install."""
    calls: Calls = []
    version = script.requirement("llama-cpp-python").partition("==")[2]
    python = script.PYTHON

    def pip(*arguments: str, watch: bool = False, environment: dict[str, str] | None = None) -> None:  # noqa: ARG001
        calls.append((arguments, environment or {}))
        site = script.VENV / "lib/python3.11/site-packages" / f"llama_cpp_python-{version}.dist-info"
        site.mkdir(parents=True, exist_ok=True)

    python.parent.mkdir(parents=True)
    python.touch()
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
