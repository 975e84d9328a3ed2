"""Runs that look like evidence and are none: no claim of the paper gets a wrong verdict from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.harness.timelines.config import TimelineConfig
from s2a_bench.plugins.paper.claims import CONTRADICTED, REPRODUCED, SUPPORTED, UNDECIDED
from s2a_bench.plugins.paper.claims.plans import after, timelines
from s2a_bench.plugins.paper.claims.requests import change
from s2a_bench.plugins.paper.claims.table import judge_claims
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.report.verdicts import ClaimVerdict
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.report.conftest import REAL

MakeRun = Callable[..., StoredRun]
Made = Callable[["Kit"], StoredRun]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"cpu": "AMD Ryzen 9", "gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}
GPU = {"gpu_layers": -1, "gpu_offload_supported": True, "model": "/m/MiniCPM-V-2_6-Q4_K_M.gguf", "model_sha256": "ab"}
CPU = GPU | {"gpu_layers": 0, "gpu_offload_supported": False}
LLAMA = "http/llama-server"
LLAMA_SERVER = replace(REAL, engine="llama-server", model="/m/MiniCPM-V-2_6-Q4_K_M.gguf", quantisation="")
DUMMY = replace(REAL, model="MiniCPM-V 2.6 DUMMY", weights="dummy")
REPLAY = replace(DUMMY, engine="replay", tokens="emulated", profile="rtx-4080")


class Kit:
    """Makes runs."""

    def __init__(self, root: Path, beside: MakeRun, spoken: MakeRun) -> None:
        self.root, self.beside, self.spoken = root, beside, spoken

    def timeline(self, **settings: Any) -> StoredRun:
        """Compute a timeline run."""
        return read_run(run_timeline(TimelineConfig(**settings), self.root, NullProgress()))

    def live(self, provenance: Provenance, rate: float, **facts: Any) -> StoredRun:
        """Make a live run of the four L, with timings as one at that rate has them."""
        run = self.timeline(profiles=(), rates=(rate,))
        rows = run.table(TIMELINES).copy()
        rows["mode"], rows["emulated"], rows["title"] = "live", False, "live http/as-deployed"
        origins = Origins(provenance).to_manifest()
        modelled = {"jitter", "t_nom_cv", "prompt_s"}
        settings = {name: value for name, value in run.manifest["configuration"].items() if name not in modelled}
        manifest = {**run.manifest, "boards": [], "provenance": origins, "configuration": settings, **facts}
        return replace(run, manifest=manifest, tables=run.tables | {"timelines": rows})

    def latency(self, *, ratio: float = 6.57, manifest: dict[str, Any] | None = None, **facts: Any) -> StoredRun:
        """Make a latency run on an AGX Orin with the paper's setting by default."""
        sent = {"base64_encode": 9.13 * ratio, "network": 0.87 * ratio, "inference": 5, "return": 0}
        cells = {"http/as-deployed": sent, "ros/topic": {"convert": 10, "inference": 5, "return": 0}}
        return self.beside(cells, spread=0.02, manifest={"environment": ORIN, **(manifest or {})}, **facts)

    def sizes(self) -> StoredRun:
        """Make a latency run whose sides have frames of two sizes."""
        run = self.latency()
        samples = run.samples.copy()
        samples.loc[samples["pipeline"] == "ros", "size"] = "1280x720"
        return replace(run, tables=run.tables | {"samples": samples})

    def cut(self, launch: int) -> StoredRun:
        """Make a latency run without ROS in one launch."""
        run = self.latency()
        missing = (run.samples["pipeline"] == "ros") & (run.samples["launch"] == launch)
        return replace(run, tables=run.tables | {"samples": run.samples[~missing]})

    def beside_llama_server(
        self, *, without_model_ms: float = 60, engine: Provenance = REAL, server: Provenance = LLAMA_SERVER
    ) -> StoredRun:
        """Make a latency run of llama-server, 75 ms without inference, beside ROS: 20 ms, without model 35."""
        sent = {"base64_encode": 15, "ingest": 60, "inference": 55, "return": 0}
        cells = {LLAMA: sent, "ros/topic": {"convert": 20, "preprocess": 15, "inference": 80, "return": 0}}
        return self.beside(
            cells,
            spread=0.01,
            options={LLAMA: {"llama_server": "llama-server"}},
            origins={LLAMA: server, "ros/topic": engine},
            server_prompt_ms=130 - without_model_ms,
        )

    def rates(
        self,
        rate: float,
        provenance: Provenance | None,
        model: dict[str, Any],
        cells: dict[str, Provenance] | None = None,
        **facts: Any,
    ) -> StoredRun:
        """Make a throughput run on a host with an RTX 4080."""
        origins = {} if provenance is None else {"provenance": Origins(provenance, cells or {}).to_manifest()}
        return self.spoken(rate, environment=RTX, model=model, **origins, **facts)

    def ccrb(self, **settings: Any) -> StoredRun:
        """Drive a CCRB run."""
        return read_run(run_ccrb(CcrbConfig(**settings), self.root, NullProgress()))


@pytest.fixture
def kit(tmp_path: Path, beside: MakeRun, spoken: MakeRun) -> Kit:
    return Kit(tmp_path, beside, spoken)


def verdicts(*runs: StoredRun) -> dict[str, ClaimVerdict]:
    return {each.claim: each for each in judge_claims(runs)}


NO_EVIDENCE: dict[str, tuple[Made, str, str]] = {
    "a paced dummy run at the Orin's rate, on an Orin": (
        lambda kit: kit.live(replace(DUMMY, tokens="paced"), 4.8, environment=ORIN, model=GPU),
        "AGX Orin:",
        "tokens: paced",
    ),
    "a laptop at the Orin's rate": (
        lambda kit: kit.live(REAL, 4.8, environment={"cpu": "a laptop"}, model=GPU),
        "AGX Orin:",
        "board: a laptop",
    ),
    "an Orin that is far slower than the paper's": (
        lambda kit: kit.live(REAL, 2.0, environment=ORIN, model=GPU),
        "AGX Orin:",
        "tokens/s: 2.0",
    ),
    "a bare rate that is an Orin's": (lambda kit: kit.timeline(profiles=(), rates=(4.8,)), "AGX Orin:", "board"),
    "an Orin whose skills take 2 s": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), t_nom_s=(2.0,)),
        "AGX Orin:",
        "settings: t_nom_s 2.0",
    ),
    "a 4080 whose skills take .1 s": (
        lambda kit: kit.timeline(profiles=("rtx-4080",), t_nom_s=(0.1,)),
        "RTX 4080:",
        "settings: t_nom_s 0.1",
    ),
    "an Orin at one L": (
        lambda kit: kit.timeline(profiles=("jetson-agx-orin",), tokens_per_skill=(6,)),
        "AGX Orin:",
        "L: 6 (needs 6, 4, 2, 1)",
    ),
    "a CPU run on a 4080 host": (lambda kit: kit.rates(5.0, REAL, CPU), "RTX 4080: 34.2", "processor: CPU"),
    "a few layers on a 4080": (
        lambda kit: kit.rates(9.0, REAL, GPU | {"gpu_layers": 8}),
        "RTX 4080: 34.2",
        "8 layers on the GPU",
    ),
    "a text model at the 4080's rate": (
        lambda kit: kit.rates(34.2, replace(REAL, pictures="not seen"), GPU),
        "RTX 4080: 34.2",
        "pictures: not seen",
    ),
    "dummy weights at the 4080's rate": (lambda kit: kit.rates(34.2, DUMMY, GPU), "RTX 4080: 34.2", "weights: dummy"),
    "a paced server": (
        lambda kit: kit.rates(34.2, replace(REAL, tokens="paced"), GPU),
        "RTX 4080: 34.2",
        "tokens: paced",
    ),
    "a paced cell of a run that is measured": (
        lambda kit: kit.rates(34.2, REAL, GPU, cells={"in-process": replace(REAL, tokens="paced")}),
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
    "a stream-mode run: 6.57": (lambda kit: kit.latency(mode="stream"), "6.57 times", "mode: stream"),
    "a stream-mode run: colours": (lambda kit: kit.latency(mode="stream"), "colour conversions", "mode: stream"),
    "pictures encoded for HTTP": (
        lambda kit: kit.latency(payloads={"http": "jpeg"}),
        "6.57 times",
        "payload: jpeg and raw",
    ),
    "an emulated link": (
        lambda kit: kit.latency(manifest={"provenance": Origins(replace(REAL, link="emulated")).to_manifest()}),
        "6.57 times",
        "link: emulated",
    ),
    "an emulated link on one side": (
        lambda kit: kit.latency(origins={"http/as-deployed": replace(REAL, link="emulated")}),
        "HTTP/JSON takes longer",
        "link: emulated, real",
    ),
    "a replayed RTX 4080 beside a dummy": (
        lambda kit: kit.latency(origins={"http/as-deployed": REPLAY, "ros/topic": DUMMY}),
        "HTTP/JSON takes longer",
        "engine replay and llama",
    ),
    "two profiles, replayed": (
        lambda kit: kit.latency(origins={"http/as-deployed": REPLAY, "ros/topic": replace(REPLAY, profile="orin")}),
        "6.57 times",
        "profile rtx-4080 and orin",
    ),
    "a dummy beside a model": (
        lambda kit: kit.latency(origins={"ros/topic": DUMMY}),
        "Most HTTP overhead",
        "weights real and dummy",
    ),
    "two model files": (
        lambda kit: kit.latency(origins={"ros/topic": replace(REAL, model_sha256="cd")}),
        "colour conversions",
        "model_sha256 ab and cd",
    ),
    "servers that do not tell": (
        lambda kit: kit.latency(manifest={"provenance": {}}),
        "HTTP/JSON takes longer",
        "engine unknown",
    ),
    "two sizes": (lambda kit: kit.sizes(), "HTTP/JSON takes longer", "size 640x480 and 1280x720"),
    "a new client for each request beside a kept connection": (
        lambda kit: kit.latency(options={"http/as-deployed": {"connection": "client-per-request"}}),
        "HTTP/JSON takes longer",
        "both sides: http/as-deployed with connection client-per-request (needs",
    ),
    "DDS as it comes": (
        lambda kit: kit.latency(options={"ros/topic": {"payload": "raw", "dds_tuning": "default"}}),
        "6.57 times",
        "both sides: ros/topic with dds_tuning default (needs",
    ),
    "a server at a URL, maybe a proxy to another machine": (
        lambda kit: kit.latency(options={"http/as-deployed": {"url": "http://10.0.0.2:8080"}}),
        "HTTP/JSON takes longer",
        "servers: http/as-deployed by url (needs",
    ),
    "a node of others over ROS": (
        lambda kit: kit.latency(options={"ros/topic": {"action": "/generate_response"}}),
        "6.57 times",
        "servers: ros/topic by action (needs",
    ),
    "a black box": (
        lambda kit: kit.beside(
            {"http/as-deployed": {"json_pack": 1, "server": 300}, "ros/topic": {"convert": 10, "inference": 5}},
            options={"http/as-deployed": {"url": "http://10.0.0.2:8080"}},
            origins={"http/as-deployed": Provenance()},
        ),
        "HTTP/JSON takes longer",
        "servers: http/as-deployed by url (needs",
    ),
    "a run that does not say whose servers": (
        lambda kit: kit.latency(manifest={"configuration": {}}),
        "HTTP/JSON takes longer",
        "servers: http/as-deployed unknown, ros/topic unknown",
    ),
    "one launch of 50": (lambda kit: kit.latency(launches=1), "HTTP/JSON takes longer", "launches: 1 (needs 3 or"),
    "two launches": (lambda kit: kit.latency(launches=2), "6.57 times", "launches: 2 (needs 3 or more)"),
    "a third launch that one side did not finish": (
        lambda kit: kit.cut(launch=2),
        "colour conversions",
        "launches: 2 (needs 3 or more)",
    ),
    "llama-server on another file": (
        lambda kit: kit.beside_llama_server(server=replace(LLAMA_SERVER, model_sha256="cd")),
        "HTTP/JSON takes longer",
        "model_sha256 cd and ab",
    ),
    "llama-server on a file that is not known": (
        lambda kit: kit.beside_llama_server(
            server=replace(LLAMA_SERVER, model_sha256=""), engine=replace(REAL, model_sha256="")
        ),
        "6.57 times",
        "engine llama-server and llama",
    ),
    "llama-server beside an echo": (
        lambda kit: kit.beside_llama_server(engine=replace(REAL, engine="echo")),
        "HTTP/JSON takes longer",
        "engine llama-server and echo",
    ),
    "another machine": (lambda kit: kit.latency(manifest={"environment": RTX}), "6.57 times", "board: AMD Ryzen 9"),
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
    "ccrb at one point": (lambda kit: kit.ccrb(), "less safe", "study: point (needs phase)"),
    "the diagram of fast boards": (
        lambda kit: kit.ccrb(phase=True, phase_points=(3, 3), phase_rates=(20.0, 40.0)),
        "less safe",
        "phase_rates [20.0, 40.0]",
    ),
}


@pytest.mark.parametrize("case", NO_EVIDENCE)
def test_what_is_no_evidence_decides_nothing_and_says_what_is_missing(kit: Kit, case: str) -> None:
    make, claims, missing = NO_EVIDENCE[case]
    found = {text: each for text, each in verdicts(make(kit)).items() if claims in text and each.evidence}
    assert found
    for each in found.values():
        assert each.verdict == UNDECIDED, each.claim
        assert not each.tested
        (finding,) = each.evidence
        assert missing in "; ".join(need.text for need in finding.needs if not need.met), each.required


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
            "Stream-to-act has no significant latency penalty: at the end, S0 known": UNDECIDED,
            "Stream-to-act has no significant latency penalty: at the end, S0 estimated": SUPPORTED,
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
    "the paper's ratio": (
        lambda kit: kit.latency(),
        {
            "HTTP/JSON takes longer end to end than ROS 2-native": SUPPORTED,
            "101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": SUPPORTED,
        },
    ),
    "the paper's ratio, payloads named": (
        lambda kit: kit.latency(
            options={"http/as-deployed": {"payload": "jpeg-preencoded"}, "ros/topic": {"payload": "raw"}}
        ),
        {"HTTP/JSON takes longer end to end than ROS 2-native": SUPPORTED},
    ),
    "the paper's ratio, replayed on both sides": (
        lambda kit: kit.latency(manifest={"provenance": Origins(REPLAY).to_manifest()}),
        {"HTTP/JSON takes longer end to end than ROS 2-native": SUPPORTED},
    ),
    "llama-server beside our engine on the same file": (
        lambda kit: kit.beside_llama_server(),
        {"HTTP/JSON takes longer end to end than ROS 2-native": SUPPORTED},
    ),
    "llama-server whose preprocessing alone is longer": (
        lambda kit: kit.beside_llama_server(without_model_ms=30),
        {"HTTP/JSON takes longer end to end than ROS 2-native": CONTRADICTED},
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


@pytest.mark.parametrize(
    ("settings", "shown"),
    [
        ({"n_skills": (2,)}, "n_skills 2"),
        ({"t_max": 20.0}, "t_max 20.0"),
        ({"t_min": 0.5}, "t_min 0.5"),
        ({"prompt_s": 9.0}, "prompt_s 9.0"),
        ({"t_nom_cv": 0.5, "plans": 20}, "t_nom_cv 0.5"),
        ({"jitter": "lognormal:cv=1.5", "t_max": 20.0, "plans": 20}, "t_max 20.0, jitter lognormal:cv=1.5"),
    ],
)
def test_plans_with_other_settings_than_the_chosen_are_measured_and_not_judged(
    kit: Kit, settings: dict[str, Any], shown: str
) -> None:
    found = verdicts(kit.timeline(profiles=("jetson-agx-orin",), **settings))
    concerned = [each for text, each in found.items() if text.startswith("AGX Orin: ") or "fast and smooth" in text]
    assert len(concerned) == 4
    for each in concerned:
        (finding,) = each.evidence
        assert (each.verdict, each.tested) == (UNDECIDED, False)
        assert [need.text.partition(" (needs ")[0] for need in finding.needs if not need.met] == [f"settings: {shown}"]
        assert finding.text.startswith("At your settings, no verdict: ")
        assert " at L = 6" in finding.text or "no plan stalls" in finding.text


@pytest.mark.parametrize(
    ("quantisation", "rate", "verdict"),
    [
        ("Q4_K", 20.0, CONTRADICTED),
        ("Q4_K", 50.0, UNDECIDED),
        ("Q8_0", 20.0, UNDECIDED),
        ("Q8_0", 50.0, UNDECIDED),
        ("BF16", 20.0, UNDECIDED),
        ("BF16", 50.0, CONTRADICTED),
        ("BF16", 34.0, SUPPORTED),
        ("mine", 20.0, UNDECIDED),
    ],
)
def test_a_rate_that_no_quantisation_explains_contradicts(
    kit: Kit, quantisation: str, rate: float, verdict: str
) -> None:
    run = kit.rates(rate, replace(REAL, quantisation=quantisation), GPU)
    assert verdicts(run)["RTX 4080: 34.2 tokens/s"].verdict == verdict


def stalling(run: StoredRun, every: int) -> StoredRun:
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
        assert judged.tested
        assert judged.notes[-1].startswith("Runs disagree")
        assert {"Supported", "Contradicted"} == {finding.text.partition(":")[0] for finding in judged.evidence}
        assert all(run.path.name in judged.text for run in runs)


def test_what_a_llama_server_does_not_show_is_not_judged_by_stages(kit: Kit) -> None:
    found = verdicts(kit.beside_llama_server())
    (finding,) = found["ROS latency is dominated by lightweight colour conversions"].evidence
    assert [need.text for need in finding.needs if not need.met] == ["stages: hidden by http/llama-server (needs seen)"]
    assert found["HTTP/JSON takes longer end to end than ROS 2-native"].evidence


def test_cells_of_one_run_are_judged_each(kit: Kit) -> None:
    run = kit.latency()
    rows = run.samples
    other = rows[rows["pipeline"] == "http"].assign(cell="http/as-deployed?payload=png", payload="png")
    import pandas as pd

    both = replace(run, tables=run.tables | {"samples": pd.concat([rows, other], ignore_index=True)})
    assert verdicts(both)["HTTP/JSON takes longer end to end than ROS 2-native"].verdict == SUPPORTED
    turned = replace(run, tables=run.tables | {"samples": pd.concat([other, rows], ignore_index=True)})
    assert verdicts(turned)["HTTP/JSON takes longer end to end than ROS 2-native"].verdict == SUPPORTED


def test_policies_are_compared_plan_by_plan(kit: Kit) -> None:
    """All run the same plans: the spread between plans cancels."""
    (part,) = timelines(
        kit.timeline(profiles=(), rates=(4.8,), tokens_per_skill=(6,), jitter="lognormal:cv=0.5", plans=60)
    )
    ends_s = (part.cells[6][policy].values("end_s") for policy in ("wait-then-act", "naive"))
    apart = change(*ends_s, part.run.bootstrap_seed).ratio.ci95
    (ratio,), _ = after("wait-then-act", "naive", "end_s").measure(part)
    assert apart is not None
    assert ratio.ci95 is not None
    assert ratio.ci95[1] - ratio.ci95[0] < (apart[1] - apart[0]) / 2
