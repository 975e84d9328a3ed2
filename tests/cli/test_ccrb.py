"""`s2a-bench ccrb` as a user runs it."""

from __future__ import annotations

from pathlib import Path

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
