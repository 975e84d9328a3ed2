"""Every simulator keeps the contract; CARLA against a stand-in of its client API."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from s2a_bench.scenario import Simulator, simulator
from s2a_bench.scenario.carla import Carla
from s2a_bench.testing.simulator import SimulatorSuite
from tests.scenario.carla_stand_in import World, package


class TestLongitudinal(SimulatorSuite):
    EXACT = 1e-9

    @pytest.fixture
    def world(self) -> Simulator:
        return simulator("longitudinal")


class TestEmbedded(SimulatorSuite):
    @pytest.fixture
    def world(self) -> Simulator:
        return simulator("embedded")


class TestCarla(SimulatorSuite):
    EXACT = 0.25  # steps of 20 ms

    @pytest.fixture
    def world(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Simulator]:
        monkeypatch.setitem(sys.modules, "carla", package(World()))
        built = Carla()
        yield built
        built.close()
