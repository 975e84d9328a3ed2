"""Runs that look like evidence and are none: no claim of the paper gets a wrong verdict from them.

And the text of every claim: tests/data/claims.md has it for runs that cover all cases. Where another text is meant, the
failing test says where the new page lies.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import pytest

from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.experiments.ccrb.config import CcrbComputed
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.plugins.paper.claims import CONTRADICTED, SUPPORTED, UNDECIDED, judge
from s2a_bench.plugins.paper.claims.plans import after, timelines
from s2a_bench.plugins.paper.claims.requests import change
from s2a_bench.plugins.paper.claims.table import CLAIMS
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.report.verdicts import ClaimVerdict
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.plugins.paper.test_claims import MakeRow, MakeRun, bodies
from tests.report.conftest import REAL

Made = Callable[["Kit"], StoredRun]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"cpu": "AMD Ryzen 9", "gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}
GPU = {"gpu_layers": -1, "gpu_offload_supported": True, "model": "/m/MiniCPM-V-2_6-Q4_K_M.gguf", "model_sha256": "ab"}
CPU = GPU | {"gpu_layers": 0, "gpu_offload_supported": False}
LLAMA = "http/llama-server"
LONGER = "HTTP/JSON takes longer end to end than ROS 2-native"
LLAMA_SERVER = replace(REAL, engine="llama-server", model="/m/MiniCPM-V-2_6-Q4_K_M.gguf", quantisation="")
DUMMY = replace(REAL, model="MiniCPM-V 2.6 DUMMY", weights="dummy")
REPLAY = replace(DUMMY, engine="replay", tokens="emulated", profile="rtx-4080")


class Kit:
    """Makes runs."""

    computed: ClassVar[dict[str, StoredRun]] = {}

    def __init__(self, root: Path, beside: MakeRun, spoken: MakeRun) -> None:
        self.root, self.beside, self.spoken = root, beside, spoken

    def timeline(self, **settings: Any) -> StoredRun:
        """Compute a timeline run, once of the same settings."""
        key = repr(sorted(settings.items()))
        if key not in self.computed:
            run = run_timeline(TimelineComputed(**settings), self.root, NullProgress())
            self.computed[key] = read_run(run)
        return self.computed[key]

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
        provenance: Provenance | None = REAL,
        rate: float = 34.2,
        model: dict[str, Any] = GPU,
        cells: dict[str, Provenance] | None = None,
    ) -> StoredRun:
        """Make a throughput run on a host with an RTX 4080."""
        origins = {} if provenance is None else {"provenance": Origins(provenance, cells or {}).to_manifest()}
        return self.spoken(rate, environment=RTX, model=model, **origins)

    def ccrb(self, **settings: Any) -> StoredRun:
        """Drive a CCRB run."""
        return read_run(run_ccrb(CcrbComputed(**settings), self.root, NullProgress()))


@pytest.fixture
def kit(tmp_path: Path, beside: MakeRun, spoken: MakeRun) -> Kit:
    return Kit(tmp_path, beside, spoken)


def verdicts(about: str, *runs: StoredRun) -> dict[str, ClaimVerdict]:
    """Judge the claims whose place and text match."""
    return {each.text: judge(each, runs) for each in CLAIMS if re.search(about, f"{each.where}: {each.text}")}


def verdict(claim: str, *runs: StoredRun) -> ClaimVerdict:
    (found,) = verdicts(re.escape(claim), *runs).values()
    return found


NO_EVIDENCE: dict[str, dict[str, tuple[Made, str]]] = {
    "AGX Orin:": {
        "a paced dummy run at the Orin's rate, on an Orin": (
            lambda kit: kit.live(replace(DUMMY, tokens="paced"), 4.8, environment=ORIN, model=GPU),
            "tokens: paced",
        ),
        "an Orin that is far slower than the paper's": (
            lambda kit: kit.live(REAL, 2.0, environment=ORIN, model=GPU),
            "tokens/s: 2.0",
        ),
        "a bare rate that is an Orin's": (lambda kit: kit.timeline(profiles=(), rates=(4.8,)), "board"),
        "an Orin whose skills take 2 s": (
            lambda kit: kit.timeline(profiles=("jetson-agx-orin",), t_nom_s=(2.0,)),
            "settings: t_nom_s 2.0",
        ),
        "an Orin at one L": (
            lambda kit: kit.timeline(profiles=("jetson-agx-orin",), tokens_per_skill=(6,)),
            "L: 6 (needs 6, 4, 2, 1)",
        ),
    },
    "RTX 4080: 34.2": {
        "a text model": (lambda kit: kit.rates(replace(REAL, pictures="not seen")), "pictures: not seen"),
        "dummy weights": (lambda kit: kit.rates(DUMMY), "weights: dummy"),
        "a paced cell": (lambda kit: kit.rates(cells={"in-process": replace(REAL, tokens="paced")}), "tokens: paced"),
        "a replayed profile": (lambda kit: kit.rates(replace(REAL, tokens="emulated")), "tokens: emulated"),
        "an unknown quantisation": (lambda kit: kit.rates(replace(REAL, quantisation="")), "quantisation: unknown"),
        "another file than ours": (lambda kit: kit.rates(replace(REAL, model_sha256="cd")), "processor: unknown"),
        "another model": (
            lambda kit: kit.rates(replace(REAL, model="qwen2"), model=GPU | {"model": "q.gguf"}),
            "model: qwen2",
        ),
    },
    "6.57 times": {
        "a stream-mode run": (lambda kit: kit.latency(mode="stream"), "mode: stream"),
        "pictures encoded for HTTP": (lambda kit: kit.latency(payloads={"http": "jpeg"}), "payload: jpeg and raw"),
        "an emulated link": (
            lambda kit: kit.latency(manifest={"provenance": Origins(replace(REAL, link="emulated")).to_manifest()}),
            "link: emulated",
        ),
        "two profiles, replayed": (
            lambda kit: kit.latency(origins={"http/as-deployed": REPLAY, "ros/topic": replace(REPLAY, profile="orin")}),
            "profile rtx-4080 and orin",
        ),
        "DDS as it comes": (
            lambda kit: kit.latency(options={"ros/topic": {"payload": "raw", "dds_tuning": "default"}}),
            "both sides: ros/topic with dds_tuning default (needs",
        ),
        "a node of others over ROS": (
            lambda kit: kit.latency(options={"ros/topic": {"action": "/generate_response"}}),
            "servers: ros/topic by action (needs",
        ),
        "two launches": (lambda kit: kit.latency(launches=2), "launches: 2 (needs 3 or more)"),
        "llama-server on a file that is not known": (
            lambda kit: kit.beside_llama_server(
                server=replace(LLAMA_SERVER, model_sha256=""), engine=replace(REAL, model_sha256="")
            ),
            "engine llama-server and llama",
        ),
        "another machine": (lambda kit: kit.latency(manifest={"environment": RTX}), "board: AMD Ryzen 9"),
    },
    "HTTP/JSON takes longer": {
        "an emulated link on one side": (
            lambda kit: kit.latency(origins={"http/as-deployed": replace(REAL, link="emulated")}),
            "link: emulated, real",
        ),
        "a replayed RTX 4080 beside a dummy": (
            lambda kit: kit.latency(origins={"http/as-deployed": REPLAY, "ros/topic": DUMMY}),
            "engine replay and llama",
        ),
        "servers that do not tell": (lambda kit: kit.latency(manifest={"provenance": {}}), "engine unknown"),
        "two sizes": (lambda kit: kit.sizes(), "size 640x480 and 1280x720"),
        "a black box": (
            lambda kit: kit.latency(
                options={"http/as-deployed": {"url": "http://10.0.0.2:8080"}},
                origins={"http/as-deployed": Provenance()},
            ),
            "servers: http/as-deployed by url (needs",
        ),
        "a run that does not say whose servers": (
            lambda kit: kit.latency(manifest={"configuration": {}}),
            "servers: http/as-deployed unknown, ros/topic unknown",
        ),
    },
    "colour conversions": {
        "two model files": (
            lambda kit: kit.latency(origins={"ros/topic": replace(REAL, model_sha256="cd")}),
            "model_sha256 ab and cd",
        ),
    },
    "CCRB:": {"another rate": (lambda kit: kit.ccrb(rate=34.2), "rate 34.2")},
    "less safe": {
        "the diagram of fast boards": (
            lambda kit: kit.ccrb(phase=True, phase_points=(3, 3), phase_rates=(20.0, 40.0)),
            "phase_rates [20.0, 40.0]",
        ),
    },
}


@pytest.mark.parametrize(
    ("claims", "case"), [(claims, case) for claims, cases in NO_EVIDENCE.items() for case in cases]
)
def test_what_is_no_evidence_decides_nothing_and_says_what_is_missing(kit: Kit, claims: str, case: str) -> None:
    make, missing = NO_EVIDENCE[claims][case]
    found = [each for each in verdicts(re.escape(claims), make(kit)).values() if each.evidence]
    assert found
    for each in found:
        assert each.verdict == UNDECIDED, each.claim
        assert not each.tested
        (finding,) = each.evidence
        assert missing in "; ".join(need.text for need in finding.needs if not need.met), each.required


EVIDENCE: dict[str, tuple[Made, dict[str, str]]] = {
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
    "the paper's ratio, payloads named": (
        lambda kit: kit.latency(
            options={"http/as-deployed": {"payload": "jpeg-preencoded"}, "ros/topic": {"payload": "raw"}}
        ),
        {LONGER: SUPPORTED},
    ),
    "the paper's ratio, replayed on both sides": (
        lambda kit: kit.latency(manifest={"provenance": Origins(REPLAY).to_manifest()}),
        {LONGER: SUPPORTED},
    ),
    "llama-server whose preprocessing alone is longer": (
        lambda kit: kit.beside_llama_server(without_model_ms=30),
        {LONGER: CONTRADICTED},
    ),
    "half the paper's ratio": (
        lambda kit: kit.latency(ratio=3.3),
        {"101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": CONTRADICTED},
    ),
    "ten per cent off": (
        lambda kit: kit.latency(ratio=6.57 * 1.1),
        {"101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin": UNDECIDED},
    ),
}


@pytest.mark.parametrize("case", EVIDENCE)
def test_evidence_decides_by_its_intervals(kit: Kit, case: str) -> None:
    make, wanted = EVIDENCE[case]
    run = make(kit)
    assert {text: verdict(text, run).verdict for text in wanted} == wanted


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
    run = kit.timeline(profiles=("jetson-agx-orin",), **settings)
    concerned = verdicts(": AGX Orin: |fast and smooth", run)
    assert len(concerned) == 4
    for each in concerned.values():
        (finding,) = each.evidence
        assert (each.verdict, each.tested) == (UNDECIDED, False)
        assert [need.text.partition(" (needs ")[0] for need in finding.needs if not need.met] == [f"settings: {shown}"]
        assert finding.text.startswith("At your settings, no verdict: ")
        assert " at L = 6" in finding.text or "no plan stalls" in finding.text


@pytest.mark.parametrize(
    ("quantisation", "rate", "wanted"),
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
    kit: Kit, quantisation: str, rate: float, wanted: str
) -> None:
    run = kit.rates(replace(REAL, quantisation=quantisation), rate)
    assert verdict("RTX 4080: 34.2 tokens/s", run).verdict == wanted


def stalling(run: StoredRun, every: int) -> StoredRun:
    """Let every so-manieth plan of stream-to-act stall, and no other."""
    rows = run.table(TIMELINES).copy()
    ours = rows["policy"] == "stream-to-act"
    rows.loc[ours, "any_stall"] = rows.loc[ours, "plan"] % every == 0
    return replace(run, tables=run.tables | {"timelines": rows})


def test_runs_that_disagree_are_undecided_and_both_are_listed_in_any_order(kit: Kit) -> None:
    one, other = kit.latency(), kit.latency(ratio=3.3)
    for runs in ((one, other), (other, one)):
        judged = verdict("101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin", *runs)
        assert judged.verdict == UNDECIDED
        assert judged.tested
        assert judged.notes[-1].startswith("Runs disagree")
        assert {"Supported", "Contradicted"} == {finding.text.partition(":")[0] for finding in judged.evidence}
        assert all(run.path.name in judged.text for run in runs)


def test_what_a_llama_server_does_not_show_is_not_judged_by_stages(kit: Kit) -> None:
    run = kit.beside_llama_server()
    (finding,) = verdict("ROS latency is dominated by lightweight colour conversions", run).evidence
    assert [need.text for need in finding.needs if not need.met] == ["stages: hidden by http/llama-server (needs seen)"]
    assert verdict(LONGER, run).evidence


def test_cells_of_one_run_are_judged_each(kit: Kit) -> None:
    run = kit.latency()
    rows = run.samples
    other = rows[rows["pipeline"] == "http"].assign(cell="http/as-deployed?payload=png", payload="png")
    for samples in ([rows, other], [other, rows]):
        both = replace(run, tables=run.tables | {"samples": pd.concat(samples, ignore_index=True)})
        assert verdict(LONGER, both).verdict == SUPPORTED


def test_policies_are_compared_plan_by_plan(kit: Kit) -> None:
    """All run the same plans: the spread between plans cancels."""
    (part,) = timelines(
        kit.timeline(profiles=(), rates=(4.8,), tokens_per_skill=(6,), jitter="lognormal:cv=0.5", plans=60)
    )
    ends_s = (part.cells[6][policy].values("end_s") for policy in ("wait-then-act", "naive"))
    apart = change(*ends_s, part.run.bootstrap_seed).ratio.ci95
    (ratio,), _ = after("wait-then-act", "naive", "end_s").measure(part)
    assert ratio.ci95[1] - ratio.ci95[0] < (apart[1] - apart[0]) / 2


PAGE = Path(__file__).parents[2] / "data" / "claims.md"


def claim_lines(about: str, run: StoredRun) -> list[str]:
    """Return the text of every claim that matches and that this run can judge, or nearly so."""
    judged = [each for each in verdicts(about, run).values() if each.evidence]
    texts = [f"- **{each.where}: {each.claim}**: {each.verdict}. {each.text} *{each.required}*\n" for each in judged]
    return [text.replace(run.path.name, "RUN") for text in texts]


def test_what_is_said_of_claims_is_the_page(kit: Kit, make_run: MakeRun, make_row: MakeRow, tmp_path: Path) -> None:
    def elsewhere(run: StoredRun, **environment: object) -> StoredRun:
        return replace(run, manifest={**run.manifest, "environment": environment})

    def boundary(**settings: object) -> StoredRun:
        return read_run(run_boundary(BoundaryConfig(**settings), tmp_path, NullProgress()))  # type: ignore[arg-type]

    orin = {"profiles": ("jetson-agx-orin",), "tokens_per_skill": (1, 2, 4, 6)}
    jitter = orin | {"jitter": "lognormal:cv=0.2", "plans": 60}
    runs: dict[str, Callable[[], StoredRun]] = {  # title, with the claims it is about in brackets
        "Timelines of table II": lambda: elsewhere(kit.timeline(), **RTX),
        "Timelines with jitter, every 20th of ours stalling (Orin: |V-E: |IV-F: )": lambda: elsewhere(
            stalling(kit.timeline(**jitter), every=20)
        ),
        "Timelines of one skill, of varying duration (Orin: naive|V-E: |IV-F: )": lambda: elsewhere(
            kit.timeline(**jitter, n_skills=(1,), t_nom_cv=0.1), **ORIN
        ),
        "Timelines of two skills (IV-F: )": lambda: kit.timeline(**orin, n_skills=(2,), t_max=1.0),
        "Timelines of ours alone (Orin: naive|More tokens|at the end)": lambda: elsewhere(
            kit.timeline(**orin, policies=("stream-to-act",)), **ORIN
        ),
        "Timelines on an Orin (Orin: |RTX|V-E: )": lambda: kit.live(REAL, 4.8, environment=ORIN, model=GPU),
        "Transports": kit.latency,
        "Transports, alike": lambda: kit.latency(ratio=1.0),
        "Transports, a sample a launch": lambda: kit.latency(n=3),
        "Transports, one launch": lambda: kit.latency(launches=1),
        "Transports, a replay behind a proxy beside a dummy (takes longer)": lambda: kit.latency(
            launches=1,
            options={"http/as-deployed": {"url": "http://127.0.0.1:8080"}},
            manifest={"provenance": Origins(DUMMY, {"http/as-deployed": REPLAY}).to_manifest()},
        ),
        "Transports, llama-server (longer|6.57)": kit.beside_llama_server,
        "Bodies": lambda: bodies(make_run, make_row, 90_000, 120_500),
        "Small bodies": lambda: bodies(make_run, make_row, 49_999, 66_666),
        "A rate (V-D, table II)": lambda: kit.rates(rate=34.0),
        "Another rate (V-D, table II)": lambda: kit.rates(rate=50.0),
        "A rate of layers on CPU and GPU (V-D, table II)": lambda: kit.rates(rate=34.0, model=GPU | {"gpu_layers": 8}),
        "A rate of no layers on the GPU (V-D, table II)": lambda: kit.rates(rate=34.0, model=GPU | {"gpu_layers": 0}),
        "A rate of a server that does not tell (V-D, table II)": lambda: kit.rates(None, 34.0, {}),
        "Boundary": boundary,
        "Boundary, all on one line (Below)": lambda: boundary(t_min=1.0),
        "CCRB": lambda: kit.ccrb(phase=True, phase_points=(3, 3)),
        "CCRB of another follower, at one point (V-F)": lambda: kit.ccrb(scenario={"follower": "idm"}),
    }
    page = "# What is said of the paper's claims\n"
    for title, made in runs.items():
        heading, _, about = title.rstrip(")").partition(" (")
        page += f"\n## {heading}\n\n" + "".join(claim_lines(about, made()))
    page = re.sub(r"off by \S+ s", "off by ~0 s", page)
    (tmp_path / "claims.md").write_text(page, "utf-8")
    lines = difflib.unified_diff(PAGE.read_text("utf-8").splitlines(), page.splitlines(), n=0, lineterm="")
    assert not list(lines), f"if that is meant: cp {tmp_path / 'claims.md'} {PAGE}"
