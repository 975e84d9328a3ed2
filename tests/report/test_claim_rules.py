"""What verdicts are made of: intervals between bounds, boards, and models on their GPUs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from s2a_bench.provenance import Provenance
from s2a_bench.report.claims.claim import CONTRADICTED, SUPPORTED, UNDECIDED, Part, within
from s2a_bench.report.claims.intervals import near, verdict_of
from s2a_bench.report.claims.needs import GPU, is_board, machine_of
from s2a_bench.report.claims.timeline_parts import all_of
from s2a_bench.stats import Ratio
from s2a_bench.store.run import Run

MakeRun = Callable[..., Run]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (1.0, 2.0, SUPPORTED),
        (0.9, 2.0, UNDECIDED),
        (1.0, 2.1, UNDECIDED),
        (0.9, 2.1, UNDECIDED),
        (0.5, 1.0, UNDECIDED),
        (2.0, 3.0, UNDECIDED),
        (0.5, 0.9, CONTRADICTED),
        (2.1, 3.0, CONTRADICTED),
    ],
)
def test_an_interval_is_wholly_between_the_bounds_or_wholly_outside_or_decides_nothing(
    low: float, high: float, verdict: str
) -> None:
    assert within(low, high, 1.0, 2.0) == verdict
    assert verdict_of(Ratio(1.5, low, high), 1.0, 2.0) == verdict
    assert verdict_of(Ratio(1.5, low, None), 1.0, 2.0) == verdict_of(Ratio(1.5, None, high), 1.0, 2.0) == UNDECIDED


@pytest.mark.parametrize(
    ("verdicts", "verdict"),
    [
        ([SUPPORTED, SUPPORTED], SUPPORTED),
        ([SUPPORTED, UNDECIDED], UNDECIDED),
        ([SUPPORTED, UNDECIDED, CONTRADICTED], CONTRADICTED),
        ([], UNDECIDED),
    ],
)
def test_of_what_is_claimed_of_all_one_that_contradicts_is_enough(verdicts: list[str], verdict: str) -> None:
    assert all_of(verdicts) == verdict


def test_a_mean_is_like_the_papers_within_ten_per_cent() -> None:
    assert near(Ratio(1.0, 0.91, 1.09), "So.") == (SUPPORTED, "So.")
    assert near(Ratio(1.0, 0.89, 1.09), "So.") == near(Ratio(1.0, 0.91, 1.11), "So.") == (UNDECIDED, "So.")
    assert near(Ratio(1.2, 1.11, 1.3), "So.") == (CONTRADICTED, "So.")
    assert near(Ratio(1.0, None, None), "So.") == (UNDECIDED, "So. Too few samples for an interval.")


@pytest.mark.parametrize(
    ("offload", "layers", "found", "met"),
    [
        (True, -1, "all layers on the GPU", True),
        (True, 28, "all layers on the GPU", True),
        (True, 27, "27 layers on the GPU", False),
        (True, 0, "CPU", False),
        (False, 28, "CPU", False),
        (None, 28, "unknown", False),
        (True, None, "unknown", False),
    ],
)
def test_a_model_is_on_the_gpu_with_all_its_28_layers(
    make_run: MakeRun, offload: bool | None, layers: int | None, found: str, met: bool
) -> None:
    model = {"gpu_offload_supported": offload, "gpu_layers": layers, "model_sha256": "ab"}
    part = Part(make_run({}, manifest={"model": model}), "", None, (Provenance(model_sha256="ab"),))
    assert (GPU.of(part).found, GPU.of(part).met) == (found, met)
    others = replace(part, origins=(*part.origins, Provenance(model_sha256="cd")))
    assert (GPU.of(others).found, GPU.of(others).met) == ("unknown", False)


@pytest.mark.parametrize(
    ("environment", "name", "same"),
    [
        (ORIN, "Jetson AGX Orin", True),
        (ORIN, "Jetson Orin Nano", False),
        ({"board": "NVIDIA Jetson Orin Nano Super Developer Kit"}, "Jetson AGX Orin", False),
        ({"board": "Jetson AGX Orin"}, "Jetson AGX Orin", True),
        ({"board": "AGX Orin NX"}, "Jetson AGX Orin", True),
        ({"board": "AGX"}, "Jetson AGX Orin", False),
        (RTX, "RTX 4080", True),
        ({"gpus": [{"name": "RTX 4080"}]}, "RTX 4080", True),
        ({"gpus": [{}, {"name": "My NVIDIA GeForce RTX 4080 16 GB"}]}, "RTX 4080", True),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 SUPER"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 Laptop GPU"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 40800"}]}, "RTX 4080", False),
        ({}, "RTX 4080", False),
    ],
)
def test_a_board_is_known_by_its_whole_name(
    make_run: MakeRun, environment: dict[str, Any], name: str, same: bool
) -> None:
    assert is_board(make_run({}, manifest={"environment": environment}), name) == same


@pytest.mark.parametrize(
    ("environment", "named"),
    [
        (RTX | {"cpu": "AMD Ryzen 9"}, "AMD Ryzen 9, NVIDIA GeForce RTX 4080"),
        (ORIN | {"gpus": []}, "NVIDIA Jetson AGX Orin Developer Kit"),
        ({}, "a machine that is not known"),
    ],
)
def test_a_machine_is_named_by_what_is_known_of_it(make_run: MakeRun, environment: dict[str, Any], named: str) -> None:
    assert machine_of(make_run({}, manifest={"environment": environment})) == named
