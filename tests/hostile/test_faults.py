"""Whatever is killed, whenever: the client ends with one line within its bound, and others are answered."""

from __future__ import annotations

import os

import pytest

from benchmarks.faults import FAULTS, Fault, outcomes

SHORT = {"http/best-effort", "ros/topic"}
"""The transports of the shorter form; `make hostile` runs all."""
WHOLE = os.environ.get("S2A_HOSTILE") == "whole"
LANES = 1 if WHOLE else 3
"""Of all transports there are eight lanes, so there is enough to wait for at once."""


@pytest.fixture(scope="module")
def came(request: pytest.FixtureRequest) -> dict[Fault, str]:
    """What came of the faults of all tests that were chosen: those of several transports happen at once."""
    specs = [getattr(item, "callspec", None) for item in request.session.items]
    chosen = [spec.params.get("fault") for spec in specs if spec is not None]
    return outcomes([fault for fault in chosen if isinstance(fault, Fault)], LANES)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [fault for fault in FAULTS if WHOLE or fault.transport in SHORT], ids=str)
def test_what_comes_of_a_fault_is_what_is_promised(fault: Fault, came: dict[Fault, str]) -> None:
    assert came[fault] in fault.promised
