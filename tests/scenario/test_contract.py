"""Every simulator keeps the contract."""

from __future__ import annotations

from dataclasses import dataclass

import highway_env  # noqa: F401 - its import sets a variable of the environment
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.scenario import SIMULATORS, open_simulator
from s2a_bench.scenario.longitudinal import Longitudinal
from s2a_bench.testing.simulator import SimulatorSuite


class TestLongitudinal(SimulatorSuite):
    name = "longitudinal"
    PLACED = DRIVEN = 1e-9


class TestEmbedded(SimulatorSuite):
    name = "embedded"


@dataclass
class Far(Longitudinal):
    """What another package might offer: a server somewhere."""

    host: str = "here"
    port: int = 2000

    def __post_init__(self) -> None:
        super().__init__()


def test_parameters_of_a_simulator_are_the_fields_of_its_dataclass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIMULATORS._builtins, "far", f"{__name__}:Far")
    monkeypatch.setattr("s2a_bench.registry.resolve_name", lambda _: Far)
    far = open_simulator("far?port=2042")
    assert isinstance(far, Far)
    assert (far.host, far.port) == ("here", 2042)
    with pytest.raises(UsageError, match=r"^`simulator`: far: port = 'x': input should be a valid integer"):
        open_simulator("far?port=x")
    with pytest.raises(UsageError, match=r"^`simulator`: far: 'hots' is not a parameter; .* did you mean host"):
        open_simulator("far?hots=there")
