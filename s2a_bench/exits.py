"""How processes end: the exit codes of our own, and those of a child in words that say what to do."""

from __future__ import annotations

from signal import SIGILL

TRIPPED = 3
"""Exit code of `compare` where a gate trips."""
UNDECIDED = 4
"""Exit code of `compare` where no gate trips and one could not have seen a change of the size of its limit."""

SETUP_AGAIN = "run `make setup` again"
COMPILE_AGAIN = "compile it on this machine"
"""The way out for a program that is the user's own."""


def how_it_ended(code: int | None, cure: str = SETUP_AGAIN) -> str:
    """Describe a `returncode` of `subprocess`; an illegal instruction says where it comes from, and the ``cure``."""
    if code is None or code >= 0:
        return f"exit code {code}"
    if -code != SIGILL:
        return f"killed by signal {-code}"
    return (
        f"killed by signal {-code} (SIGILL): llama.cpp was compiled for another processor, or by a compiler whose "
        f"code for AMX does not work; {cure}"
    )
