"""The expected timelines of the shared POLICY page, section 4, to the digits shown there."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pytest

from s2a_bench.policy import Plans, policy
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.metrics import measure

N_SKILLS, T_NOM_S = 8, 1.0
PROMPT_S = {"34.2": 0.05, "4.8": 0.5, ".58": 3.0}

EXPECTED = """
34.2 6  0/0/.23/8.23        0/0/1.45/9.45    0/0/.23/8.23
4.8  6  7/1.75/1.75/11.50   0/0/10.50/18.50  0/0/3.50/11.50
4.8  4  0/0/1.33/9.33       0/0/7.17/15.17   0/0/1.33/9.33
.58  6  7/65.4/13.3/86.8    0/0/85.8/93.8    0/0/78.8/86.8
.58  1  7/5.07/4.72/17.8    0/0/16.8/24.8    0/0/9.79/17.8
"""
"""R, L, then stalls / total stall / start / end for the three policies, T_nom = 1 s, N = 8."""

POLICY_NAMES = ("naive", "wait-then-act", "s2a-clairvoyant")

CASES = [
    (rate, int(length), name, cell)
    for rate, length, *cells in (line.split() for line in EXPECTED.strip().splitlines())
    for name, cell in zip(POLICY_NAMES, cells, strict=True)
]


def shown(value: float, like: str) -> Decimal:
    """Round a value to as many digits as the table shows."""
    return Decimal(repr(value)).quantize(Decimal(like))


@pytest.mark.parametrize(("rate", "length", "name", "cell"), CASES)
def test_a_timeline_has_the_numbers_of_the_table(rate: str, length: int, name: str, cell: str) -> None:
    arrival_s = uniform(PROMPT_S[rate], length, float(rate), N_SKILLS)
    nominal_s = np.full_like(arrival_s, T_NOM_S)
    plans = Plans(arrival_s, nominal_s, 0.8 * nominal_s, 1.5 * nominal_s)
    found = measure(plans, policy(name).schedule(plans))
    stalls, stall_s, start_s, end_s = cell.split("/")
    assert found.stalls[0] == int(stalls)
    assert shown(found.stall_s[0].item(), stall_s) == Decimal(stall_s)
    assert shown(found.first_action_s[0].item(), start_s) == Decimal(start_s)
    assert shown(found.end_s[0].item(), end_s) == Decimal(end_s)
