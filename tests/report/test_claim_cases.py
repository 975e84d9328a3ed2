"""Runs that look like evidence and are none: no claim of the paper gets a wrong verdict from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.report.claims.claim import CONTRADICTED, REPRODUCED, SUPPORTED, UNDECIDED
from s2a_bench.report.claims.verdicts import Judged, judge_claims
from s2a_bench.store.run import Run, read_run
from s2a_bench.testing import NullProgress

MakeRun = Callable[..., Run]
Made = Callable[["Kit"], Run]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"cpu": "AMD Ryzen 9", "gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}
GPU = {"gpu_layers": -1, "gpu_offload_supported": True, "model": "/m/MiniCPM-V-2_6-Q4_K_M.gguf", "model_sha256": "ab"}
CPU = GPU | {"gpu_layers": 0, "gpu_offload_supported": False}
REAL = Provenance("llama", "MiniCPM-V 2.6", "ab", "Q4_K_M", "real", "measured")
DUMMY = replace(REAL, model="MiniCPM-V 2.6 DUMMY", weights="dummy")


class Kit:
    """Makes runs."""

    def __init__(self, root: Path, make_run: MakeRun, spoken: MakeRun) -> None:
        self.root, self.make_run, self.spoken = root, make_run, spoken

    def timeline(self, **asked: Any) -> Run:
        """Compute a timeline run."""
        return read_run(run_timeline(TimelineConfig(**asked), self.root, NullProgress()))

    def live(self, provenance: Provenance, rate: float, **facts: Any) -> Run:
        """Make a live run of the four L, with timings as one at that rate has them."""
        run = self.timeline(profiles=(), rates=(rate,))
        rows = run.table(TIMELINES).copy()
        rows["mode"], rows["emulated"], rows["title"] = "live", False, "live http/as-deployed"
        origins = Origins(provenance).to_manifest()
        manifest = {**run.manifest, "boards": [], "provenance": origins, "configuration": {}, **facts}
        return replace(run, manifest=manifest, tables=run.tables | {"timelines": rows})

    def latency(
        self, *, ratio: float = 6.57, http: str = "jpeg-preencoded", mode: str = "request", **manifest: Any
    ) -> Run:
        """Make a latency run on an AGX Orin with the paper's setting, unless told otherwise."""
        sent = {"base64_encode": 9.13 * ratio, "network": 0.87 * ratio, "inference": 5, "return": 0}
        cells = {"http/as-deployed": sent, "ros/topic": {"convert": 10, "inference": 5, "return": 0}}
        payloads = {"http": http, "ros": "raw"}
        return self.make_run(
            cells, spread=0.02, payloads=payloads, mode=mode, manifest={"environment": ORIN, **manifest}
        )

    def rates(self, rate: float, provenance: Provenance | None, model: dict[str, Any], **facts: Any) -> Run:
        """Make a throughput run on a host with an RTX 4080."""
        origins = {} if provenance is None else {"provenance": Origins(provenance).to_manifest()}
        return self.spoken(rate, environment=RTX, model=model, **origins, **facts)

    def ccrb(self, **asked: Any) -> Run:
        """Drive a CCRB run."""
        return read_run(run_ccrb(CcrbConfig(**asked), self.root, NullProgress()))


@pytest.fixture
def kit(tmp_path: Path, make_run: MakeRun, spoken: MakeRun) -> Kit:
    return Kit(tmp_path, make_run, spoken)


def verdicts(*runs: Run) -> dict[str, Judged]:
    return {each.claim.text: each for each in judge_claims(runs)}


NO_EVIDENCE: dict[str, tuple[Made, str, str]] = {
    "a paced dummy run at the Orin's rate, on an Orin": (
        lambda kit: kit.live(replace(DUMMY, tokens="paced"), 4.8, environment=ORIN, model=GPU),
        "AGX Orin:",
        "tokens paced",
    ),
    "a model of others at the Orin's rate, on an Orin": (
        lambda kit: kit.live(replace(REAL, model="qwen2"), 4.8, environment=ORIN, model=GPU | {"model": "q.gguf"}),
        "AGX Orin:",
        "model qwen2",
    ),
    "a laptop at the Orin's rate": (
        lambda kit: kit.live(REAL, 4.8, environment={"cpu": "a laptop"}, model=GPU),
        "AGX Orin:",
        "board a laptop",
    ),
    "a server that does not tell, on an Orin": (
        lambda kit: kit.live(Provenance(), 4.8, environment=ORIN),
        "AGX Orin:",
        "weights unknown",
    ),
    "a CPU run on a 4080 host, timelines": (
        lambda kit: kit.live(REAL, 34.2, environment=RTX, model=CPU),
        "RTX 4080:",
        "processor CPU",
    ),
    "an Orin that is far slower than the paper's": (
        lambda kit: kit.live(REAL, 2.0, environment=ORIN, model=GPU),
        "AGX Orin:",
        "rate 2 tokens/s",
    ),
    "a bare rate that is an Orin's": (lambda kit: kit.timeline(profiles=(), rates=(4.8,)), "AGX Orin:", "board"),
    "an Orin whose skills take 2 s": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), t_nom_s=(2.0,)),
        "AGX Orin:",
        "T_nom = 2 s",
    ),
    "a 4080 whose skills take .1 s": (
        lambda kit: kit.timeline(profiles=("rtx-4080",), t_nom_s=(0.1,)),
        "RTX 4080:",
        "T_nom = 0.1 s",
    ),
    "an Orin at one L": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), tokens_per_skill=(6,)),
        "AGX Orin:",
        "L = 6 with",
    ),
    "a CPU run on a 4080 host": (lambda kit: kit.rates(5.0, REAL, CPU), "RTX 4080: 34.2", "processor: CPU"),
    "a few layers on a 4080": (
        lambda kit: kit.rates(9.0, REAL, GPU | {"gpu_layers": 8}),
        "RTX 4080: 34.2",
        "8 layers on the GPU",
    ),
    "all layers but one of the 28 on a 4080": (
        lambda kit: kit.rates(34.2, REAL, GPU | {"gpu_layers": 27}),
        "RTX 4080: 34.2",
        "27 layers on the GPU",
    ),
    "dummy weights at the 4080's rate": (lambda kit: kit.rates(34.2, DUMMY, GPU), "RTX 4080: 34.2", "weights: dummy"),
    "a paced server": (
        lambda kit: kit.rates(34.2, replace(REAL, tokens="paced"), GPU),
        "RTX 4080: 34.2",
        "tokens: paced",
    ),
    "a replayed profile": (
        lambda kit: kit.rates(34.2, replace(REAL, engine="replay", tokens="emulated"), GPU, engine="replay"),
        "RTX 4080: 34.2",
        "tokens: emulated",
    ),
    "a server that does not tell": (lambda kit: kit.rates(34.2, None, {}), "RTX 4080: 34.2", "weights: unknown"),
    "an unknown quantisation": (
        lambda kit: kit.rates(34.2, replace(REAL, quantisation=""), GPU),
        "RTX 4080: 34.2",
        "quantisation: unknown",
    ),
    "a server of others beside a model of ours": (
        lambda kit: kit.rates(34.2, replace(REAL, model_sha256="cd"), GPU),
        "RTX 4080: 34.2",
        "processor: unknown",
    ),
    "another model": (
        lambda kit: kit.rates(34.2, replace(REAL, model="qwen2"), GPU | {"model": "q.gguf"}),
        "RTX 4080: 34.2",
        "model: qwen2",
    ),
    "a stream-mode run: slower": (lambda kit: kit.latency(mode="stream"), "HTTP/JSON takes longer", "mode: stream"),
    "a stream-mode run: 6.57": (lambda kit: kit.latency(mode="stream"), "6.57 times", "mode: stream"),
    "a stream-mode run: figure 6": (lambda kit: kit.latency(mode="stream"), "Most HTTP overhead", "mode: stream"),
    "a stream-mode run: colours": (lambda kit: kit.latency(mode="stream"), "colour conversions", "mode: stream"),
    "pictures encoded for HTTP": (lambda kit: kit.latency(http="jpeg"), "6.57 times", "payload: jpeg and raw"),
    "an emulated link": (
        lambda kit: kit.latency(provenance=Origins(replace(REAL, link="emulated")).to_manifest()),
        "6.57 times",
        "link: emulated",
    ),
    "another machine": (lambda kit: kit.latency(environment=RTX), "6.57 times", "board: AMD Ryzen 9"),
    "ccrb --rate 34.2": (lambda kit: kit.ccrb(rate=34.2), "CCRB:", "rate 34.2"),
    "ccrb with a driver of another kind": (
        lambda kit: kit.ccrb(scenario={"follower": "idm"}),
        "CCRB:",
        "follower idm",
    ),
    "the diagram of a board that thinks longer": (
        lambda kit: kit.ccrb(phase=True, phase_points=(3, 3), prompt_s=3.0),
        "less safe",
        "prompt_s 3.0",
    ),
    "ccrb at one point": (lambda kit: kit.ccrb(), "less safe", "one operating point"),
    "the diagram of fast boards": (
        lambda kit: kit.ccrb(phase=True, phase_points=(3, 3), phase_rates=(20.0, 40.0)),
        "less safe",
        "phase_rates [20.0, 40.0]",
    ),
}


@pytest.mark.parametrize("case", NO_EVIDENCE)
def test_what_is_no_evidence_decides_nothing_and_says_what_is_missing(kit: Kit, case: str) -> None:
    make, claims, missing = NO_EVIDENCE[case]
    found = {text: each for text, each in verdicts(make(kit)).items() if claims in text and each.findings}
    assert found
    for each in found.values():
        assert each.verdict == UNDECIDED, each.claim.text
        assert each.needs_run
        (finding,) = each.findings
        assert missing in "; ".join(str(need) for need in finding.needs if not need.met), each.required


EVIDENCE: dict[str, tuple[Made, dict[str, str]]] = {
    "the paper's model with all of its 28 layers on a 4080": (
        lambda kit: kit.rates(34.2, REAL, GPU | {"gpu_layers": 28}),
        {"RTX 4080: 34.2 tokens/s": SUPPORTED},
    ),
    "the paper's model on the Orin's GPU": (
        lambda kit: kit.live(REAL, 4.8, environment=ORIN, model=GPU),
        {"AGX Orin: stream-to-act eliminates stalls": UNDECIDED},  # one plan each: no interval
    ),
    "jittered Orin": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2"),
        {
            "AGX Orin: stream-to-act eliminates stalls": SUPPORTED,
            "AGX Orin: wait-then-act avoids stalls but ends later": SUPPORTED,
            "AGX Orin: naive shows intermittent stalls": UNDECIDED,
            "RTX 4080: all policies run smoothly with no noticeable stalls": UNDECIDED,
            "More tokens a skill raise naive's stalls": SUPPORTED,
            "Stream-to-act has no significant latency penalty: at the end": SUPPORTED,
        },
    ),
    "a jittered Orin's few plans": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2", plans=20),
        {"AGX Orin: stream-to-act eliminates stalls": UNDECIDED},
    ),
    "a careless stream-to-act": (
        lambda kit: stalling(kit.timeline(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2"), every=20),
        {"AGX Orin: stream-to-act eliminates stalls": CONTRADICTED},
    ),
    "a stream-to-act that promises little": (
        lambda kit: stalling(
            kit.timeline(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2", epsilon=0.3), every=20
        ),
        {"AGX Orin: stream-to-act eliminates stalls": CONTRADICTED},
    ),
    "a few stalls, as promised": (
        lambda kit: stalling(kit.timeline(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2"), every=500),
        {"AGX Orin: stream-to-act eliminates stalls": SUPPORTED},
    ),
    "table II's rate": (lambda kit: kit.rates(34.0, REAL, GPU), {"RTX 4080: 34.2 tokens/s": SUPPORTED}),
    "another rate, maybe of another quantisation": (
        lambda kit: kit.rates(50.0, REAL, GPU),
        {"RTX 4080: 34.2 tokens/s": UNDECIDED},
    ),
    "the paper's ratio": (
        lambda kit: kit.latency(),
        {
            "HTTP/JSON takes longer end to end than ROS 2-native": SUPPORTED,
            "101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": SUPPORTED,
        },
    ),
    "half the paper's ratio": (
        lambda kit: kit.latency(ratio=3.3),
        {"101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": CONTRADICTED},
    ),
    "ten per cent off": (
        lambda kit: kit.latency(ratio=6.57 * 1.1),
        {"101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": UNDECIDED},
    ),
    "the chosen point": (
        lambda kit: kit.ccrb(),
        {
            "CCRB: naive is hit from behind": REPRODUCED,
            "CCRB: wait-then-act hits the car ahead": REPRODUCED,
            "CCRB: stream-to-act hits nobody": REPRODUCED,
        },
    ),
}


@pytest.mark.parametrize("case", EVIDENCE)
def test_evidence_decides_by_its_intervals(kit: Kit, case: str) -> None:
    make, wanted = EVIDENCE[case]
    found = verdicts(make(kit))
    assert {text: found[text].verdict for text in wanted} == wanted


def stalling(run: Run, every: int) -> Run:
    """Let every so-manieth plan of stream-to-act stall, and no other."""
    rows = run.table(TIMELINES).copy()
    ours = rows["policy"] == "stream-to-act"
    rows.loc[ours, "any_stall"] = rows.loc[ours, "plan"] % every == 0
    return replace(run, tables=run.tables | {"timelines": rows})


def test_runs_that_disagree_are_undecided_and_both_are_listed_in_any_order(kit: Kit) -> None:
    one, other = kit.latency(), kit.latency(ratio=3.3)
    for runs in ((one, other), (other, one)):
        judged = verdicts(*runs)["101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin"]
        assert judged.verdict == UNDECIDED
        assert judged.disagree
        assert judged.evidence[-1].startswith("Runs disagree")
        assert {SUPPORTED, CONTRADICTED} == {finding.verdict for finding in judged.findings}
        assert all(run.path.name in " ".join(judged.evidence) for run in runs)


def test_a_run_that_cannot_tell_takes_nothing_from_one_that_can(kit: Kit) -> None:
    runs = kit.latency(), kit.latency(mode="stream"), kit.latency(environment=RTX)
    for order in (runs, runs[::-1]):
        judged = verdicts(*order)["101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin"]
        assert judged.verdict == SUPPORTED
        assert len(judged.findings) == 3


def test_cells_of_one_run_are_judged_each(kit: Kit) -> None:
    run = kit.latency()
    rows = run.samples
    other = rows[rows["pipeline"] == "http"].assign(cell="http/as-deployed?payload=png", payload="png")
    import pandas as pd

    both = replace(run, tables=run.tables | {"samples": pd.concat([rows, other], ignore_index=True)})
    assert verdicts(both)["HTTP/JSON takes longer end to end than ROS 2-native"].verdict == SUPPORTED
    turned = replace(run, tables=run.tables | {"samples": pd.concat([other, rows], ignore_index=True)})
    assert verdicts(turned)["HTTP/JSON takes longer end to end than ROS 2-native"].verdict == SUPPORTED
