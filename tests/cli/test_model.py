"""What `model` says to wrong use and bad input, as a user runs it."""

import os
from pathlib import Path

import pytest

from tests.cli.program import program, refused


def test_no_network_is_one_line_and_code_one(tmp_path: Path) -> None:
    unreachable = {"HF_ENDPOINT": "http://127.0.0.1:1", "HF_HOME": str(tmp_path)}
    done = program("model", "fetch", "minicpm-v-2.6", code=1, env=os.environ | unreachable)
    assert done.stdout == ""
    assert "cannot be fetched from http://127.0.0.1:1" in done.stderr
    assert "set HF_ENDPOINT" in done.stderr


@pytest.mark.parametrize(
    ("content", "message"), [(b"PK\x03\x04", "not a GGUF file"), (b"GGUF\x03\x00\x00\x00", "damaged or cut short")]
)
def test_a_file_that_is_no_model_is_one_line_and_code_one(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "x.gguf"
    path.write_bytes(content)
    line = refused("model", "info", path, code=1)
    assert f"model info {path}: " in line
    assert message in line
