"""Whatever is killed, stopped or cut, whenever: the client ends with one line, and others are answered."""

from __future__ import annotations

import os

import pytest

from benchmarks.faults import FAULTS, Fault, outcomes

WHOLE = os.environ.get("S2A_HOSTILE") == "whole"
CHOSEN = [fault for fault in FAULTS if WHOLE or fault.transport == "http/best-effort"]
"""`make hostile` has all transports."""


@pytest.fixture(scope="module")
def came() -> dict[Fault, str]:
    """What came of the faults, those of several transports at once."""
    return outcomes(CHOSEN, 1 if WHOLE else 4)


@pytest.mark.slow
@pytest.mark.parametrize("fault", CHOSEN, ids=str)
def test_what_comes_of_a_fault_is_what_is_promised(fault: Fault, came: dict[Fault, str]) -> None:
    assert came[fault] in fault.promised
