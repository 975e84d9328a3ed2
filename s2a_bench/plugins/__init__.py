"""First-party plug-ins, a folder each: found by the entry points in pyproject.toml, as anybody's package is.

The core imports none of them, they do not import each other, and of the core they use what docs/library.md lists.
"""
