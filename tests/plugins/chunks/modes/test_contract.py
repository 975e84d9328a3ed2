"""Every mode keeps the contract, with its defaults and with other parameters."""

from __future__ import annotations

import pytest

from s2a_bench.plugins.chunks.modes import MODES, Mode
from s2a_bench.plugins.chunks.modes import mode as build
from s2a_bench.plugins.chunks.testing.mode import ModeSuite


@pytest.mark.parametrize("name", MODES)
class TestDefaults(ModeSuite):
    @pytest.fixture
    def mode(self, name: str) -> Mode:
        return build(name)


@pytest.mark.parametrize(
    "written",
    [
        "queue?trigger=3",
        "queue?trigger=9&execute=4",
        "sync?execute=2",
        "streamed?trigger=2&gap_s=3e-8&start=naive",
        "streamed?trigger=2&gap_s=3e-8",
        "streamed?trigger=2&gap_s=4e-9&execute=5",
        "replace?execute=3&under_way=many",
        "replace?execute=2&assumed=3",
        "aggregate?trigger=3",
        "aggregate?trigger=7&kind=average",
    ],
)
class TestParameters(ModeSuite):
    @pytest.fixture
    def mode(self, written: str) -> Mode:
        return build(written)
