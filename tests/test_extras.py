"""Without the extras: the core measures, and what needs one says in one line which."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from s2a_bench import extras
from s2a_bench.errors import MissingExtra
from s2a_bench.inference import EngineConfig
from s2a_bench.machine.doctor import Machine, host
from s2a_bench.machine.resources import Unreadable
from s2a_bench.machine.resources.nvidia import Nvml
from tests.cli.program import called, refused
from tests.cli.test_imports import OPTIONAL

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


EVERY = """
import sys
from pathlib import Path
from s2a_bench.cli import main

for line in {lines}:
    runs = [str(path) for path in Path("results").glob("*-latency-*")]
    sys.argv = ["s2a-bench", *(runs[0] if word == "RUN" else word for word in line)]
    try:
        main()
    except SystemExit as ended:
        print("exit code", ended.code, "of", line[0], flush=True)
"""
"""Runs commands one after another; RUN is the folder of the first."""


def without(modules: set[str], folder: Path, *lines: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run commands where some modules cannot be found, by their server processes neither."""
    site, inherited = folder / "site", os.environ.get("PYTHONPATH", "")
    site.mkdir(exist_ok=True)
    (site / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({modules}))\n")
    return subprocess.run(
        [sys.executable, "-c", EVERY.format(lines=lines)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{site}:{ROOT}:{inherited}", "S2A_BENCH_CACHE": str(folder / "cache")},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


BLACK_BOX = ("latency", "--transport", "http", "--url", "http://127.0.0.1:9")
LEROBOT = ("--transport", "grpc", "--policy-type", "act", "--pretrained", "x")


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("llama_cpp", "llama", ("latency", "--engine", "llama")),
        ("llama_cpp", "llama", ("throughput",)),
        ("llama_cpp", "llama", ("timeline", "--live")),
        ("llama_cpp", "llama", ("ccrb", "--live")),
        ("llama_cpp", "llama", ("profile", "capture", "x")),
        ("gguf", "llama", ("latency", "--engine", "llama")),
        ("gguf", "model", ("model", "dummy")),
        ("huggingface_hub", "model", ("model", "fetch", "minicpm-v-2.6")),
        ("huggingface_hub", "model", ("model", "list")),
        ("highway_env", "ccrb", ("ccrb", "--simulator", "embedded")),
        ("carla", "carla", ("ccrb", "--simulator", "carla")),
        ("json_numpy", "act", (*BLACK_BOX, "--dialect", "openvla", "--payload", "raw")),
        ("ray", "ray", ("sweep", "paper", "--ray", "local")),
        ("grpc", "grpc", ("latency", "--url", "grpc://a:1", *LEROBOT)),
    ],
)
def test_a_missing_library_is_one_line_with_the_command_and_leaves_nothing(
    module: str, extra: str, arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    line = refused(*arguments, code=1)
    ending = f": the package {module} is not installed; pip install '.[{extra}]' in the clone of s2a-bench"
    assert line == f"error: {extras.purposes()[extra]}{ending}"
    assert not (tmp_path / "results").exists()


def test_a_sweep_is_listed_without_extras_and_names_all_of_them_at_once(tmp_path: Path) -> None:
    missing = {"msgpack", "websockets", "zmq", "zenoh"}
    done = without(missing, tmp_path, ("sweep", "transports", "--dry-run"), ("sweep", "transports"))
    hint = "pip install '.[websocket,zmq,zenoh]' in the clone of s2a-bench"
    assert "48 of 48 cells to run" in done.stdout
    assert done.stdout.endswith("exit code 0 of sweep\nexit code 1 of sweep\n")
    *_, listed, started = done.stderr.splitlines()
    assert listed.endswith(f"its cells need packages that are not installed; {hint}")
    assert started == f"error: {listed}"
    assert not (tmp_path / "results").exists()


def test_a_server_without_a_library_says_so_in_one_line(tmp_path: Path) -> None:
    done = without({"llama_cpp"}, tmp_path, ("serve", "http"))
    assert done.stdout == "exit code 1 of serve\n"
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {extras.purposes()['llama']}: the package llama_cpp is not installed; pip install")


CORE = [
    "latency --transport loopback,http --requests 3 --warmup 1 --max-tokens 4 --size 64x48",
    "timeline --profile rtx-4080 --tokens-per-skill 6 --data-only",
    "boundary --data-only",
    "ccrb --data-only",
    "chunks --cycles 100 --data-only",
    "doctor",
    "report RUN",
    "compare RUN RUN",
    "profile list",
    "serve --help",
]


def test_the_core_needs_no_extra_and_the_echo_engine_answers(tmp_path: Path) -> None:
    done = without(OPTIONAL, tmp_path, *map(str.split, CORE))
    ends = [line for line in done.stdout.splitlines() if line.startswith("exit code ")]
    assert ends == [f"exit code 0 of {line.split()[0]}" for line in CORE], done.stderr
    assert "Traceback" not in done.stderr
    assert "Echo engine" in done.stdout
    (advice,) = (line for line in done.stderr.splitlines() if "pip install" in line)
    assert advice.endswith("the echo engine answers, without a model; pip install '.[llama]' in the clone of s2a-bench")


def test_a_black_box_needs_no_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in OPTIONAL:
        monkeypatch.setitem(sys.modules, name, None)
    done = called(*BLACK_BOX, code=1)
    assert "nothing answers at http://127.0.0.1:9" in done.stderr
    assert "pip install" not in done.stderr


def test_llama_answers_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    assert EngineConfig().default_name(lines.append) == "llama"
    assert lines == []
    monkeypatch.setitem(sys.modules, "llama_cpp", None)
    assert EngineConfig().default_name(lines.append) == "echo"
    assert len(lines) == 1


def test_a_library_that_does_not_load_is_one_line_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_library.py").write_text("raise OSError('libcuda.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtra, match=r"broken_library does not load \(libcuda.so.1: .*\[llama\]"):
        extras.require("broken_library", "llama")
    with pytest.raises(MissingExtra, match=r"^theirs: broken_library does not load"):  # a package's, which says no more
        extras.require("broken_library", "theirs")


def test_without_nvml_a_gpu_is_not_watched_and_the_reason_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", None)
    with pytest.raises(Unreadable, match=r"pynvml is not installed; pip install '.\[nvidia\]'"):
        Nvml()


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_core_has_22_requirements_at_most_beside_backports(machine: str) -> None:
    environment = {"platform_machine": machine, "python_version": "3.12"}
    required = map(Requirement, PROJECT["dependencies"])
    assert len([each for each in required if not each.marker or each.marker.evaluate(environment)]) <= 22


def test_every_extra_is_described_and_in_all() -> None:
    offered = PROJECT["optional-dependencies"]
    older = {"lerobot": "grpc", "openvla": "act"}
    assert offered.keys() == {*extras.purposes(), "all", "dev", *older}
    assert {name: offered[name] for name in older} == {name: [f"s2a-bench[{new}]"] for name, new in older.items()}
    (everything,) = (Requirement(text).extras for text in offered["all"])
    assert everything | {"model"} == set(extras.purposes())
    (made,) = (Requirement(text).extras for text in offered["dev"] if text.startswith("s2a-bench"))
    assert made == everything - {"ray", "carla"}


@pytest.mark.parametrize(
    ("there", "level", "message", "fix"),
    [
        ({"numpy": "2", "gguf": "1", "ray": "2"}, "state", "3 requirements, all met", ""),
        (
            {"numpy": "2", "gguf": "1"},
            "state",
            "2 requirements, all met; without the extras ray (sweeps, and fleets of robots, on a Ray cluster)",
            "pip install '.[ray]' in the clone of s2a-bench",
        ),
        ({"numpy": "2", "gguf": "0.1", "ray": "2"}, "error", "gguf is 0.1, not >=1", "make setup"),
        ({"gguf": "1", "ray": "2"}, "error", "numpy is missing", "make setup"),
    ],
)
def test_the_doctor_knows_which_extras_are_there(
    there: dict[str, str], level: str, message: str, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = ["numpy>=1", 'gguf>=1; extra == "model"', 'ray>=2; extra == "ray"', 'tomli; python_version < "3"']

    def version(name: str) -> str:
        if name not in there:
            raise PackageNotFoundError(name)
        return there[name]

    monkeypatch.setattr(host, "requires", lambda _name: stated)
    monkeypatch.setattr(host, "version", version)
    found = host.packages(Machine())
    assert (found.level, found.message, found.fix) == (level, message, fix)


def test_no_message_names_an_extra_that_there_is_not() -> None:
    for path in (ROOT / "s2a_bench").rglob("*.py"):
        names = set(re.findall(r"how_to_install\([\"']([a-z-]+)[\"']", path.read_text()))
        assert names <= extras.purposes().keys(), path
