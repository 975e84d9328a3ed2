"""What several commands by hand share: lists of names, and the width of tables."""

from __future__ import annotations

WIDTH = 100
"""Columns of the tables where the output is no terminal."""


def listed(text: str) -> tuple[str, ...]:
    """Split at commas, each name once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
