"""What verdicts are made of: intervals between bounds, boards, and models on their GPUs."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nextafter
from typing import Any

import pytest

from s2a_bench.plugins.paper.claims import (
    CONTRADICTED,
    REPRODUCED,
    SUPPORTED,
    UNDECIDED,
    Check,
    ClaimFinding,
    RunPart,
    all_of,
    combine,
    within,
)
from s2a_bench.plugins.paper.claims.requests import PAPERS_MODEL, facts_of, on_board
from s2a_bench.plugins.paper.claims.table import CLAIMS
from s2a_bench.provenance import Provenance
from s2a_bench.report.verdicts import Met
from s2a_bench.stats import Ratio
from s2a_bench.store.run import StoredRun

MakeRun = Callable[..., StoredRun]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}


def unmeasured(_: RunPart) -> tuple[list[Ratio], str]:
    return [], ""


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
    check = Check("", unmeasured, 1.0, 2.0)
    assert within(low, high, 1.0, 2.0) == check.verdict([Ratio(1.5, low, high)]) == verdict
    assert check.verdict([Ratio(1.5, low, None)]) == check.verdict([Ratio(1.5, None, high)]) == UNDECIDED
    assert Check("", unmeasured).verdict([Ratio(1.5, None, None)]) == SUPPORTED  # only stated


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


@pytest.mark.parametrize(
    ("values", "each", "alike", "one"),
    [
        ((1, 2), SUPPORTED, SUPPORTED, SUPPORTED),
        ((1, 3), CONTRADICTED, UNDECIDED, SUPPORTED),
        ((0, 3), CONTRADICTED, UNDECIDED, UNDECIDED),
        ((3, 4), CONTRADICTED, CONTRADICTED, CONTRADICTED),
        ((0, -1), CONTRADICTED, CONTRADICTED, CONTRADICTED),
    ],
)
def test_values_lie_inside_each_or_together_or_one_of_them(
    values: tuple[float, ...], each: str, alike: str, one: str
) -> None:
    exact = [Ratio(value, value, value) for value in values]
    assert Check("", unmeasured, 1, 2).verdict(exact) == each
    assert Check("", unmeasured, 1, 2, "joint").verdict(exact) == alike
    assert Check("", unmeasured, 1, 2, "one").verdict(exact) == one


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.56, 0.6, SUPPORTED),
        (0.54, 0.6, UNDECIDED),
        (0.51, 0.52, UNDECIDED),
        (0.4, 0.46, UNDECIDED),
        (0.4, 0.44, CONTRADICTED),
    ],
)
def test_an_interval_within_the_margin_of_a_bound_decides_nothing(low: float, high: float, verdict: str) -> None:
    assert Check("", unmeasured, 0.5, margin=0.05).verdict([Ratio(0.5, low, high)]) == verdict


def test_more_than_a_half_is_not_a_half() -> None:
    more = Check("", unmeasured, nextafter(0.5, inf))
    assert more.verdict([Ratio(0.5, 0.5, 0.5)]) == CONTRADICTED
    assert more.verdict([Ratio(0.6, 0.5, 0.7)]) == UNDECIDED
    assert more.verdict([Ratio(0.6, 0.51, 0.7)]) == SUPPORTED


@pytest.mark.parametrize(
    ("testable", "others", "verdict"),
    [
        ([], [], UNDECIDED),
        ([], [UNDECIDED], UNDECIDED),
        ([SUPPORTED], [], SUPPORTED),
        ([SUPPORTED, SUPPORTED], [UNDECIDED], SUPPORTED),
        ([REPRODUCED], [UNDECIDED], REPRODUCED),
        ([CONTRADICTED], [SUPPORTED], CONTRADICTED),
        ([UNDECIDED], [], UNDECIDED),
        ([UNDECIDED], [SUPPORTED], UNDECIDED),
        ([SUPPORTED, UNDECIDED], [], UNDECIDED),
        ([CONTRADICTED, UNDECIDED], [], UNDECIDED),
        ([SUPPORTED, CONTRADICTED], [], UNDECIDED),
    ],
)
def test_runs_that_can_tell_have_to_agree_and_no_other_counts(
    testable: list[str], others: list[str], verdict: str
) -> None:
    findings = [ClaimFinding(verdict, str(place), (Met("board: it", True),)) for place, verdict in enumerate(testable)]
    findings += [ClaimFinding(verdict, "", (Met("board: another (needs it)", False),)) for verdict in others]
    for order in (findings, findings[::-1]):
        judged = combine(CLAIMS[0], dict.fromkeys(order, ("run",)))
        assert judged.verdict == verdict
        assert judged.tested == bool(testable)
        assert any("disagree" in note for note in judged.notes) == (len(set(testable)) > 1)
        assert any(note.startswith("Run: ") for note in judged.notes) == (not testable)


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
    run, ours = make_run({}, manifest={"model": model}), Provenance(model_sha256="ab")
    on_gpu = PAPERS_MODEL[2].of(facts_of(run, [ours]))
    assert on_gpu.met == met
    assert on_gpu.text.startswith(f"processor: {found}")
    assert facts_of(run, [ours, Provenance(model_sha256="cd")])["processor"] == "unknown"


@pytest.mark.parametrize(
    ("environment", "name", "same"),
    [
        (ORIN, "Jetson AGX Orin", True),
        (ORIN, "Jetson Orin Nano", False),
        ({"board": "NVIDIA Jetson Orin Nano Super Developer Kit"}, "Jetson AGX Orin", False),
        ({"board": "AGX Orin NX"}, "Jetson AGX Orin", True),
        ({"board": "AGX"}, "Jetson AGX Orin", False),
        (RTX, "RTX 4080", True),
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
    assert on_board(name).of(facts_of(make_run({}, manifest={"environment": environment}), [])).met == same


@pytest.mark.parametrize(
    ("environment", "named"),
    [
        (RTX | {"cpu": "AMD Ryzen 9"}, "AMD Ryzen 9, NVIDIA GeForce RTX 4080"),
        (ORIN | {"gpus": []}, "NVIDIA Jetson AGX Orin Developer Kit"),
        ({}, "a machine that is not known"),
    ],
)
def test_a_machine_is_named_by_what_is_known_of_it(make_run: MakeRun, environment: dict[str, Any], named: str) -> None:
    assert facts_of(make_run({}, manifest={"environment": environment}), [])["board"] == named
