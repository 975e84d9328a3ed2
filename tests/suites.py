"""Which part of a suite, and over which middleware, where the rest would test the same again."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import pytest

from s2a_bench.ros import default_middleware

Suite = TypeVar("Suite", bound=type)
once = pytest.mark.parametrize("from_pypi", [default_middleware({})], indirect=True)
"""Over one middleware from PyPI: no part of the test sees which."""


def only(*tests: str) -> Callable[[Suite], Suite]:
    """Keep the tests of these names in a class that inherits from a suite; each must be there."""

    def keep(suite: Suite) -> Suite:
        inherited = {name for name in dir(suite) if name.startswith("test_")}
        assert inherited.issuperset(tests), {*tests} - inherited
        for name in inherited.difference(tests):
            setattr(suite, name, None)
        return suite

    return keep
