"""The text of every claim: tests/data/claims.md has it for runs that cover all cases.

Where another text is meant, the failing test says where the new page lies.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.plugins.paper.claims.table import judge_claims
from s2a_bench.provenance import Origins
from s2a_bench.store.requests import SampleRow
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.plugins.paper.test_claim_cases import DUMMY, GPU, ORIN, REPLAY, RTX, Kit, MakeRun, stalling
from tests.report.conftest import REAL

PAGE = Path(__file__).parents[2] / "data" / "claims.md"
MakeRow = Callable[..., SampleRow]
SENT = {"convert": 10, "inference": 5, "return": 0}


def claim_lines(*runs: StoredRun) -> list[str]:
    """Return the text of every claim that these runs can judge, or nearly so."""
    judged = [each for each in judge_claims(runs) if each.evidence]
    texts = [f"- **{each.where}: {each.claim}**: {each.verdict}. {each.text} *{each.required}*" for each in judged]
    names = sorted({run.path.name for run in runs}, key=len, reverse=True)
    return [re.sub("|".join(map(re.escape, names)), "RUN", text) for text in texts]


def test_what_is_said_of_claims_is_the_page(kit: Kit, make_run: MakeRun, make_row: MakeRow, tmp_path: Path) -> None:
    def elsewhere(run: StoredRun, **environment: object) -> StoredRun:
        return replace(run, manifest={**run.manifest, "environment": environment})

    def boundary(**settings: object) -> StoredRun:
        return read_run(run_boundary(BoundaryConfig(**settings), tmp_path, NullProgress()))  # type: ignore[arg-type]

    def bodies(coded: int, plain: int) -> StoredRun:
        sizes = {"http/as-deployed": coded, "http/binary": plain}
        rows = [make_row(name, SENT, 1, payload_bytes=size, request_id=name) for name, size in sizes.items()]
        return make_run({}, extra=tuple(rows))

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
        "Bodies": lambda: bodies(120_500, 90_000),
        "Small bodies": lambda: bodies(66_666, 49_999),
        "A rate (RTX|Orin: )": lambda: kit.rates(rate=34.0),
        "Another rate (RTX)": lambda: kit.rates(rate=50.0),
        "A rate of layers on CPU and GPU (RTX)": lambda: kit.rates(rate=34.0, model=GPU | {"gpu_layers": 8}),
        "A rate of no layers on the GPU (RTX)": lambda: kit.rates(rate=34.0, model=GPU | {"gpu_layers": 0}),
        "A rate of a server that does not tell (RTX)": lambda: kit.rates(None, 34.0, {}),
        "Boundary": boundary,
        "Boundary, all on one line (Below)": lambda: boundary(t_min=1.0),
        "CCRB": lambda: kit.ccrb(phase=True, phase_points=(3, 3)),
        "CCRB of another follower, at one point (naive|Naive)": lambda: kit.ccrb(scenario={"follower": "idm"}),
    }
    page = "# What is said of the paper's claims\n"
    for title, made in runs.items():
        heading, _, about = title.rstrip(")").partition(" (")
        page += f"\n## {heading}\n\n" + "".join(f"{each}\n" for each in claim_lines(made()) if re.search(about, each))
    page = re.sub(r"off by \S+ s", "off by ~0 s", page)
    (tmp_path / "claims.md").write_text(page, "utf-8")
    lines = difflib.unified_diff(PAGE.read_text("utf-8").splitlines(), page.splitlines(), n=0, lineterm="")
    assert not list(lines), f"if that is meant: cp {tmp_path / 'claims.md'} {PAGE}"
