"""The studies as a user runs them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def run(*arguments: str, output: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run ``python -m studies`` in a process of its own."""
    command = [sys.executable, "-m", "studies", *arguments, "--output", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200, cwd=ROOT)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done
