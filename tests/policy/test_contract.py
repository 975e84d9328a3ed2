"""Every policy keeps the contract, with its defaults and with other parameters."""

from __future__ import annotations

import math

import pytest

from s2a_bench.policy import POLICIES, Policy
from s2a_bench.policy import policy as build
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.testing.policy import PolicySuite


@pytest.mark.parametrize("name", POLICIES)
class TestDefaults(PolicySuite):
    @pytest.fixture
    def policy(self, name: str) -> Policy:
        return build(name)


@pytest.mark.parametrize("caution", [0.0, math.inf])
class TestStreamToAct(PolicySuite):
    @pytest.fixture
    def policy(self, caution: float) -> Policy:
        return StreamToAct(caution=caution)
