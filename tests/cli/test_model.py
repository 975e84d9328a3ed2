"""What `model` says to wrong use and bad input, as a user runs it."""

import os
from pathlib import Path

from tests.cli.program import program


def test_no_network_is_one_line_and_code_one(tmp_path: Path) -> None:
    unreachable = {"HF_ENDPOINT": "http://127.0.0.1:1", "HF_HOME": str(tmp_path)}
    done = program("model", "fetch", "minicpm-v-2.6", code=1, env=os.environ | unreachable)
    assert done.stdout == ""
    assert "cannot be fetched from http://127.0.0.1:1" in done.stderr
    assert "set HF_ENDPOINT" in done.stderr
