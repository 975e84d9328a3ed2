"""Which board is this: by device tree, GPU, CPU; what its profile's state was."""

from __future__ import annotations

import os
from typing import Any

import pytest

from s2a_bench.boards.gaps import Constant
from s2a_bench.boards.profile import Profile, load_profile
from s2a_bench.machine import environment
from s2a_bench.machine.environment import board_facts, matches, state_changes


def profile(**facts: Any) -> Profile:
    return Profile("p", "P", "measured", 5.0, 0.1, 0.0, Constant(0.2), facts={"board": facts})


@pytest.mark.parametrize(
    ("name", "here", "same"),
    [
        ("jetson-agx-orin", {"model": "NVIDIA Jetson AGX Orin Developer Kit", "cpu": "ARMv8"}, True),
        ("jetson-agx-orin", {"model": "NVIDIA Jetson AGX Orin"}, True),
        ("jetson-agx-orin", {"model": "NVIDIA Jetson AGX Xavier"}, False),
        ("jetson-agx-orin", {"model": "NVIDIA Jetson AGX"}, False),
        ("jetson-agx-orin", {"gpu": "Orin (nvgpu)"}, False),
        ("jetson-orin-nano", {"model": "NVIDIA Jetson Orin Nano Engineering Reference Developer Kit Super"}, True),
        ("jetson-orin-nano", {"model": "NVIDIA Jetson Orin NX Engineering Reference Developer Kit"}, False),
        ("rtx-4080", {"gpu": "NVIDIA GeForce RTX 4080", "cpu": "Intel"}, True),
        ("rtx-4080", {"gpu": "NVIDIA GeForce RTX 4080 SUPER"}, False),
        ("rtx-4080", {"gpu": "NVIDIA GeForce RTX 4080 Laptop GPU"}, False),
        ("rtx-4080", {"cpu": "Intel"}, False),
    ],
)
def test_the_papers_boards_are_known_by_their_names(name: str, here: dict[str, Any], same: bool) -> None:
    assert matches(load_profile(name), {"cores": 8, **here}) is same


def test_everything_that_a_profile_names_must_be_the_same() -> None:
    recorded = profile(cpu="AMD EPYC", cores=2, memory_bytes=1, power_mode="MAXN")
    assert matches(recorded, {"cpu": "AMD EPYC", "cores": 2, "power_mode": "15W"})
    assert not matches(recorded, {"cpu": "AMD EPYC", "cores": 4})
    assert not matches(profile(power_mode="MAXN"), {"power_mode": "MAXN"})  # names no board
    assert not matches(profile(), {"cpu": "AMD EPYC"})


def test_another_power_mode_or_governor_is_told() -> None:
    recorded = profile(cpu="a", power_mode="MAXN", governor="performance")
    assert state_changes(recorded, {"power_mode": "MODE_15W", "governor": "performance"}) == [
        "power mode was MAXN, is MODE_15W"
    ]
    assert state_changes(recorded, {"governor": "schedutil"}) == ["governor was performance, is schedutil"]
    assert state_changes(profile(), {"governor": "schedutil"}) == []


def test_this_machine_is_its_own_kind_of_board() -> None:
    here = board_facts()
    assert here["cores"] >= 1
    assert None not in here.values()
    assert matches(profile(**here), here)


def test_gpu_and_power_mode_are_what_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict[str, Any] = {"gpus": [{"name": "RTX", "driver": "1"}, {"name": "T4"}], "power_mode": "MODE_30W"}
    monkeypatch.setattr(environment, "collect", lambda: known)
    assert board_facts() == {"gpu": "RTX", "power_mode": "MODE_30W", "cores": len(os.sched_getaffinity(0))}
    known.clear()
    assert board_facts() == {"cores": len(os.sched_getaffinity(0))}
