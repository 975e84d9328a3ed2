"""What `model` says to wrong use and bad input, as a user runs it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "s2a_bench", "model", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=os.environ | environment,
    )


def error_of(done: subprocess.CompletedProcess[str]) -> str:
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    return line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fetch"], "Missing argument 'NAME'"),
        (["fetch", "gpt"], "model fetch: 'gpt' is neither minicpm-v-2.6 nor ORG/REPO:FILE"),
        (["fetch", "a/b:c.gguf", "--quant", "Q8_0"], "--quant Q8_0: goes with minicpm-v-2.6"),
        (["info"], "Missing argument 'FILE'"),
        (["dummy", "--quant", "q2"], "--quant: 'q2' should be 'f16'"),
    ],
)
def test_wrong_use_is_one_line_and_code_two(arguments: list[str], message: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert message in error_of(done)


def test_no_network_is_one_line_and_code_one(tmp_path: Path) -> None:
    done = run("fetch", "minicpm-v-2.6", HF_ENDPOINT="http://127.0.0.1:1", HF_HOME=str(tmp_path))
    assert done.returncode == 1
    assert "cannot be fetched from http://127.0.0.1:1" in error_of(done)
    assert "set HF_ENDPOINT" in error_of(done)


@pytest.mark.parametrize(
    ("content", "message"), [(b"PK\x03\x04", "not a GGUF file"), (b"GGUF\x03\x00\x00\x00", "damaged or cut short")]
)
def test_a_file_that_is_no_model_is_one_line_and_code_one(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "x.gguf"
    path.write_bytes(content)
    done = run("info", str(path))
    assert done.returncode == 1
    assert f"model info {path}: " in error_of(done)
    assert message in error_of(done)


def test_help_names_what_can_be_done() -> None:
    text = run("--help").stdout
    for name in ("fetch", "info", "dummy"):
        assert name in text
