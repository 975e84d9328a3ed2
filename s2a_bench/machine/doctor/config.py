"""What the doctor looks at besides the machine, and what it is strict about."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.options import Options, option


class DoctorConfig(Options):
    """How a machine is examined."""

    output: Path = option(Path("results"), "folder for run folders, whose disk is looked at")
    url: str = option("", "instead of this machine, a server that somebody else runs: what it does that is dangerous")
    strict: bool = option(False, "exit with 1 on warnings too")
