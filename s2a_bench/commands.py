"""Commands that installed packages add to the command line, beside those of `s2a_bench.cli` and the experiments."""

from __future__ import annotations

from typing import Final, NamedTuple

from s2a_bench.registry import Registry


class Command(NamedTuple):
    """A command; its declaration is read for every ``--help``, and imports as little."""

    opens: str
    """Its function, made with `cli.adapter.command`, as "module:attribute"."""
    about: str
    """Its line in ``--help``."""


COMMANDS: Final[Registry[Command]] = Registry("commands", "command", {})
