"""Research with the library, outside the wheel: when to start, on drawn plans, and whether a model's skills are valid.

`python -m studies NAME` from the top of the repository; README.md has what came of it. Only public modules of the
library are imported, those that docs/library.md lists.
"""
