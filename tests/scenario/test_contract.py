"""Every simulator keeps the contract."""

from __future__ import annotations

import highway_env  # noqa: F401 - its import sets a variable of the environment

from s2a_bench.testing.simulator import SimulatorSuite


class TestLongitudinal(SimulatorSuite):
    name = "longitudinal"
    PLACED = DRIVEN = 1e-9


class TestEmbedded(SimulatorSuite):
    name = "embedded"
