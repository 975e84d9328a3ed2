"""Tools for the tests of plug-ins: one conformance suite for each seam, a virtual clock, a null progress.

A suite is a class of pytest tests. A test module subclasses it under a name that begins with ``Test`` and provides the
fixtures that the suite's docstring names::

    import pytest
    from s2a_bench.testing.policy import PolicySuite

    class TestMyPolicy(PolicySuite):
        @pytest.fixture
        def policy(self):
            return MyPolicy(factor=2.0)

CONTRIBUTING.md names the suite of each kind; they need pytest, that of policies hypothesis too. `VirtualClock` jumps
instead of sleeping, `NullProgress` records a run's messages.
"""

from __future__ import annotations

from pkgutil import iter_modules

import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.progress import NullProgress

pytest.register_assert_rewrite(*(f"{__name__}.{module.name}" for module in iter_modules(__path__)))

__all__ = ["NullProgress", "VirtualClock"]
