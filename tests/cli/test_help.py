"""What answers at once, and what wrong use looks like."""

from __future__ import annotations

import subprocess
import sys

import pytest

from s2a_bench import __version__

HEAVY = ("llama_cpp", "cv2", "matplotlib", "pandas")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "s2a_bench", *arguments], capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["latency", "--help"],
        ["throughput", "--help"],
        ["model", "--help"],
        ["profile", "--help"],
        ["--version"],
    ],
)
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys\nsys.argv = ['s2a-bench', *sys.argv[1:]]\nfrom s2a_bench.cli import main\n"
        f"try:\n    main()\nfinally:\n    sys.stderr.write(str([n for n in {HEAVY} if n in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "[]"


def test_help_names_the_commands_that_exist() -> None:
    text = run("--help").stdout
    assert "latency" in text
    assert "model" in text


def test_every_flag_of_latency_is_explained() -> None:
    text = run("latency", "--help").stdout
    flags = "transport source size payload http wire url llama-server dds-tuning quick connection engine model mmproj"
    flags += " runs warmup mode fps max-tokens seed output record ros action json verbose against"
    for flag in flags.split():
        assert f"--{flag}" in text


def test_every_flag_of_throughput_is_explained() -> None:
    text = run("throughput", "--help").stdout
    flags = "transport source size payload http ros action url dialect api-key-env extra-body served-model llama-server"
    flags += " engine profile gaps model mmproj threads gpu-layers batch context kv-type flash-attention sampling"
    flags += " reference runs warmup max-tokens prompt grammar seed timeout output against quick json sample-resources"
    for flag in flags.split():
        assert f"--{flag} " in text


def test_the_version_is_printed() -> None:
    assert run("--version").stdout.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bogus"], "No such option: --bogus"),
        (["fly"], "No such command 'fly'"),
        (["latency", "--bogus"], "No such option: --bogus"),
        (["latency", "--runs", "many"], "'--runs'"),
        (["latency", "--port", "70000"], "'--port'"),
        (["latency", "--payload", "gif"], "--payload: 'gif' is none of jpeg, jpeg-preencoded, png, raw"),
        (["latency", "--transport", "http,pigeon"], "--transport: 'pigeon'"),
        (["latency", "--http", "fast"], "--http: 'fast'"),
        (["latency", "--size", "big"], "--size: 'big' should look like 640x480"),
        (["latency", "--engine", "gpt"], "--engine: 'gpt'"),
        (["latency", "--against", "rivals"], "--against: 'rivals' should be paper"),
        (["latency", "--prompt", "@/no/such/file"], "--prompt: cannot read /no/such/file"),
        (["latency", "--grammar", "/no/such/file"], "--grammar: cannot read /no/such/file"),
        (["latency", "--source", "webcam"], "--source: 'webcam' is none of synthetic, video"),
        (["latency", "--source", "video"], "--source: 'video' should be video:FILE"),
        (["latency", "--llama-server", "/no/such/program"], "--llama-server: /no/such/program is no program"),
    ],
)
def test_wrong_use_is_one_line_and_code_two(arguments: list[str], message: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert message in lines[0]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
