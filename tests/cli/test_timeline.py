"""`s2a-bench timeline` and `boundary` as a user runs them: the expected numbers, JSON, files, and wrong use."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.run import read_run
from tests.cli.program import called, only_run, printed
from tests.policy.test_tables import CASES, shown

BOARDS = {"34.2": "rtx-4080", "4.8": "jetson-agx-orin", ".58": "jetson-orin-nano"}
POLICIES = {"s2a-clairvoyant": "stream-to-act"}
"""With even tokens it starts at S0 as well."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what the command prints when it is given nothing."""
    found: dict[str, Any] = printed(called("timeline", "--json", "--output", tmp_path_factory.mktemp("timeline")))
    return found


@pytest.mark.parametrize(("rate", "length", "policy", "cell"), CASES)
def test_the_command_prints_the_expected_timelines(
    whole: dict[str, Any], rate: str, length: int, policy: str, cell: str
) -> None:
    wanted = (BOARDS[rate], length, POLICIES.get(policy, policy))
    (found,) = (
        each for each in whole["cells"] if (each["profile"], each["tokens_per_skill"], each["policy"]) == wanted
    )
    stalls, *rest = cell.split("/")
    assert found["stalls"] == int(stalls)
    for name, text in zip(("stall_s", "start_s", "end_s"), rest, strict=True):
        assert shown(found[name], text) == Decimal(text)


def test_the_json_has_a_cell_a_setting(whole: dict[str, Any]) -> None:
    assert whole["command"] == "timeline"
    assert len(whole["cells"]) == 3 * 4 * 3
    assert all(cell["emulated"] for cell in whole["cells"])


def test_the_run_folder_holds_skills_tokens_tables_figure_and_trace(whole: dict[str, Any]) -> None:
    kept = read_run(Path(whole["run"]))
    assert kept.manifest["state"] == "finished"
    assert len(kept.table(TIMELINES)) == 36
    assert len(kept.table(SKILLS)) == 36 * 8
    assert len(kept.tokens) == 3 * 8 * (6 + 4 + 2 + 1)
    files = {str(path.relative_to(kept.path)) for path in kept.path.rglob("*") if path.is_file()}
    for name in ("timelines", "waiting", "motion", "skills"):
        assert {f"tables/{name}.md", f"tables/{name}.tex"} <= files
    assert {"tables/timelines.csv", "figures/timeline.png", "figures/timeline.pdf"} <= files


def test_boundary_prints_json_that_keeps_its_schema_and_leaves_the_plane_as_csv(tmp_path: Path) -> None:
    done = called("boundary", "--json", "--output", tmp_path)
    found = printed(done)
    kept = only_run(tmp_path)
    lines = (kept.path / "tables" / "boundary.csv").read_text().splitlines()
    assert len(lines) - 1 == len(found["cells"]) == 2 * (8 * 25 + 3 * 4)
    assert (kept.path / "figures" / "boundary.png").stat().st_size > 0
    orin = {
        (cell["duration"], cell["tokens_per_skill"]): cell["stall_free"]
        for cell in found["cells"]
        if cell["profile"] == "jetson-agx-orin"
    }
    assert orin["t_nom", 4]  # L / R = .83 s: free at T_nom = 1 s ...
    assert not orin["t_min", 4]  # ... but not at T_min = .8 s, where the paper draws the line
    assert not orin["t_nom", 6]
