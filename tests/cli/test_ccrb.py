"""`s2a-bench ccrb` as a user runs it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.program import called, printed


def test_json_is_one_object_that_the_schema_describes(tmp_path: Path) -> None:
    whole = printed(called("ccrb", "--json", "--ttc", "--random", "4", "--data-only", "--output", tmp_path))
    outcomes = {cell["policy"]: cell["outcome"] for cell in whole["cells"]}
    assert outcomes == {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none", "s2a-ttc": "none"}
    assert [study["gap_behaviour"] for study in whole["studies"]] == ["stop", "coast", "hold", "cruise"]
    assert "stay 1 m behind" in whole["follower_law"]
    for name in ("rollouts.parquet", "trajectories.parquet", "skills.csv"):
        assert (Path(whole["run"]) / name).stat().st_size > 0, name


def test_tables_name_the_law_and_what_is_emulated(tmp_path: Path) -> None:
    done = called(
        "ccrb", "--rate", "9", "--prompt-time", "0.2", "--follower", "idm", "--data-only", "--output", tmp_path
    )
    for text in ("EMULATED: no model answered", "Rear: IDM follower", "does 'stop'", "S_front", "run folder:"):
        assert text in done.stdout


@pytest.mark.slow
def test_a_live_run_prints_one_object_and_leaves_a_whole_folder(tmp_path: Path) -> None:
    flags = ("--live", "--transport", "loopback", "--pace", "40", "--threads", "1", "--skills", "3", "--ttc")
    done = called("ccrb", *flags, "--json", "--output", tmp_path)
    whole = printed(done)
    assert [cell["policy"] for cell in whole["cells"]] == ["naive", "wait-then-act", "stream-to-act", "s2a-ttc"]
    assert {(cell["emulated"], cell["profile"]) for cell in whole["cells"]} == {(False, None)}
    assert (whole["live"]["transport"], whole["live"]["paced_tokens_per_s"]) == ("loopback", 40.0)
    folder = Path(whole["run"])
    for name in ("figures/scenario.png", "tables/outcomes.md", "samples.csv", "tokens.csv"):
        assert (folder / name).stat().st_size > 0, name
    assert "LIVE tokens over loopback, paced to 40 tokens/s" in (folder / "tables" / "outcomes.md").read_text()
