"""What the author of a plug-in needs for its tests: one conformance suite a seam, a virtual clock, a null progress.

A suite is a class of tests for pytest. A test module subclasses it under a name with ``Test`` and gives the fixtures
that its docstring names:

    import pytest
    from s2a_bench.testing.policy import PolicySuite

    class TestMyPolicy(PolicySuite):
        @pytest.fixture
        def policy(self):
            return MyPolicy(factor=2.0)

| seam | suite | fixtures |
|---|---|---|
| transport | `transport.TransportSuite` | ``told``, or the pipeline's ``name`` as an attribute |
| transport, against hostile peers | `hostile.HostileSuite` | the pipeline's ``name``, ``clients``, ``servers`` |
| engine | `engine.EngineSuite` | ``engine``, and ``fresh_engine``, which is closed |
| frame source | `frame_source.FrameSourceSuite` | ``make_source``: open it with this width and height |
| policy | `policy.PolicySuite` | ``policy`` |
| mode of acting on chunks | `mode.ModeSuite` | ``mode`` |

`VirtualClock` jumps where a real one sleeps; `NullProgress` keeps what a run says. The suites need pytest, those of
policies and modes hypothesis too.
"""

from __future__ import annotations

from pkgutil import iter_modules

import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.progress import NullProgress

pytest.register_assert_rewrite(*(f"{__name__}.{module.name}" for module in iter_modules(__path__)))

__all__ = ["NullProgress", "VirtualClock"]
