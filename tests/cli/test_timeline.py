"""`s2a-bench timeline` and `boundary` as a user runs them: the expected numbers, JSON, files, and wrong use."""

from __future__ import annotations

import json
import subprocess
import sys
from decimal import Decimal
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from s2a_bench.experiments.timeline.rows import SKILLS, TIMELINES
from s2a_bench.store.run import Run, read_run

ROOT = Path(__file__).parent.parent.parent

EXPECTED = """
rtx-4080         6  0/0/.23/8.23        0/0/1.45/9.45    0/0/.23/8.23
jetson-agx-orin  6  7/1.75/1.75/11.50   0/0/10.50/18.50  0/0/3.50/11.50
jetson-agx-orin  4  0/0/1.33/9.33       0/0/7.17/15.17   0/0/1.33/9.33
jetson-orin-nano 6  7/65.4/13.3/86.8    0/0/85.8/93.8    0/0/78.8/86.8
jetson-orin-nano 1  7/5.07/4.72/17.8    0/0/16.8/24.8    0/0/9.79/17.8
"""
"""POLICY section 4: stalls / total stall / start / end, N = 8, T_nom = 1 s, c = .05, .5 and 3 s."""

CASES = [
    (board, int(length), policy, cell)
    for board, length, *cells in (line.split() for line in EXPECTED.strip().splitlines())
    for policy, cell in zip(("naive", "wait-then-act", "stream-to-act"), cells, strict=True)
]


def run(*arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "s2a_bench", *arguments], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def schema() -> dict[str, Any]:
    found: dict[str, Any] = json.loads((ROOT / "docs" / "schema" / "s2a-bench-1.json").read_text())
    return found


def only_run(output: Path) -> Run:
    (folder,) = output.iterdir()
    return read_run(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what the command prints when it is given nothing."""
    done = run("timeline", "--json", "--output", str(tmp_path_factory.mktemp("timeline")))
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def shown(value: float, like: str) -> Decimal:
    """Round a value to as many digits as the table shows."""
    return Decimal(repr(value)).quantize(Decimal(like))


@pytest.mark.parametrize(("board", "length", "policy", "cell"), CASES)
def test_the_command_prints_the_expected_timelines(
    whole: dict[str, Any], board: str, length: int, policy: str, cell: str
) -> None:
    (found,) = [
        each
        for each in whole["cells"]
        if (each["profile"], each["tokens_per_skill"], each["policy"]) == (board, length, policy)
    ]
    stalls, stall_s, start_s, end_s = cell.split("/")
    assert found["stalls"] == int(stalls)
    assert shown(found["stall_s"], stall_s) == Decimal(stall_s)
    assert shown(found["start_s"], start_s) == Decimal(start_s)
    assert shown(found["end_s"], end_s) == Decimal(end_s)


def test_the_json_keeps_its_schema(whole: dict[str, Any]) -> None:
    jsonschema.validate(whole, schema())
    assert whole["command"] == "timeline"
    assert len(whole["cells"]) == 3 * 4 * 3
    assert all(cell["emulated"] for cell in whole["cells"])


def test_naive_and_stream_to_act_end_at_the_same_instant(whole: dict[str, Any]) -> None:
    ends: dict[tuple[str, int], dict[str, float]] = {}
    for cell in whole["cells"]:
        ends.setdefault((cell["profile"], cell["tokens_per_skill"]), {})[cell["policy"]] = cell["end_s"]
    assert len(ends) == 12
    for of in ends.values():
        assert of["naive"] == pytest.approx(of["stream-to-act"], abs=2e-9)


def test_the_run_folder_holds_skills_tokens_tables_figure_and_trace(whole: dict[str, Any]) -> None:
    kept = read_run(Path(whole["run"]))
    assert kept.manifest["state"] == "finished"
    assert len(kept.table(TIMELINES)) == 36
    assert len(kept.table(SKILLS)) == 36 * 8
    assert len(kept.tokens) == 3 * 8 * (6 + 4 + 2 + 1)
    files = {str(path.relative_to(kept.path)) for path in kept.path.rglob("*") if path.is_file()}
    for name in ("timelines", "waiting", "motion", "skills"):
        assert {f"tables/{name}.md", f"tables/{name}.tex"} <= files
    assert {"tables/timelines.csv", "figures/timeline.png", "figures/timeline.pdf", "trace.json"} <= files


def test_one_setting_shows_every_skill_and_says_what_is_emulated_and_assumed(tmp_path: Path) -> None:
    done = run(
        *("timeline", "--profile", "jetson-agx-orin", "--tokens-per-skill", "6", "--policy", "naive"),
        *("--output", str(tmp_path)),
    )
    assert "stall before" in done.stdout
    assert "EMULATED in virtual time" in done.stdout
    assert "assumption of ours" in done.stdout
    assert "11.50" in done.stdout


def test_a_given_rate_takes_the_place_of_the_profiles(tmp_path: Path) -> None:
    done = run(
        *("timeline", "--rate", "4.8,2", "--prompt-time", "0.5", "--tokens-per-skill", "6", "--n-skills", "4,8"),
        *("--jitter", "lognormal:cv=0.2", "--plans", "20", "--json", "--output", str(tmp_path)),
    )
    found = json.loads(done.stdout)
    jsonschema.validate(found, schema())
    assert {(cell["rate_tokens_per_s"], cell["n_skills"]) for cell in found["cells"]} == {
        (rate, count) for rate in (4.8, 2) for count in (4, 8)
    }
    assert {cell["profile"] for cell in found["cells"]} == {None}
    assert {cell["plans"] for cell in found["cells"]} == {20}
    assert len(list((only_run(tmp_path).path / "figures").glob("timeline_N*_T1.png"))) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "eager"], "--policy: 'eager' is none of naive, wait-then-act, stream-to-act"),
        (["--profile", "abacus"], "--profile: 'abacus' is none of"),
        (["--rate", "fast"], "--rate: 'fast' should be a valid number"),
        (["--tokens-per-skill", "1.5"], "--tokens-per-skill: '1.5' should be a valid integer"),
        (["--jitter", "fog"], "--jitter fog: family: 'fog' is none of"),
        (["--rate", "3", "--jitter", "profile"], "--jitter: profile needs --profile"),
        (["--plans", "5"], "--plans: without --jitter or --t-nom-cv all plans are the same"),
        (["--calibrate", "/nowhere"], "--calibrate: the recorded machine is one board"),
    ],
)
def test_wrong_use_is_one_line_and_leaves_no_folder(arguments: list[str], message: str, tmp_path: Path) -> None:
    output = tmp_path / "results"
    done = run("timeline", *arguments, "--output", str(output), code=2)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""
    assert not output.exists()


def test_boundary_prints_json_that_keeps_its_schema_and_leaves_the_plane_as_csv(tmp_path: Path) -> None:
    done = run("boundary", "--json", "--output", str(tmp_path))
    found = json.loads(done.stdout)
    jsonschema.validate(found, schema())
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


def test_boundary_says_that_formula_and_trial_agree(tmp_path: Path) -> None:
    text = run("boundary", "--output", str(tmp_path)).stdout
    assert "Formula and trial agree at 424 of 424 points." in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rates", "60,0.3"], "--rates: should be two tokens/s, the lower first"),
        (["--rates", "0,10"], "--rates: should be two tokens/s, the lower first"),
        (["--points", "1"], "--points: 1 should be greater than or equal to 2"),
        (["--plans", "10"], "--plans: without --jitter all plans are the same"),
        (["--jitter", "profile"], "--jitter profile: family: 'profile' is none of"),
    ],
)
def test_boundary_names_the_flag_that_is_wrong(arguments: list[str], message: str, tmp_path: Path) -> None:
    assert message in run("boundary", *arguments, "--output", str(tmp_path), code=2).stderr


@pytest.mark.parametrize("command", ["timeline", "boundary"])
def test_every_flag_is_explained_and_help_is_light(command: str) -> None:
    code = (
        "import sys\nfrom s2a_bench.cli import main\nsys.argv = ['s2a-bench', *sys.argv[1:]]\n"
        "try:\n    main()\nfinally:\n    sys.stderr.write(str([n for n in ('numpy', 'pandas') if n in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, command, "--help"], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stderr == "[]"
    flags = {
        "timeline": "policy profile rate prompt-time tokens-per-skill n-skills t-nom t-min t-max t-nom-cv jitter plans "
        "epsilon calibration-plans calibrate gap-bound seed output per-skill json",
        "boundary": "profile tokens-per-skill most-tokens rates points n-skills t-nom t-min jitter plans seed output "
        "json",
    }
    for flag in flags[command].split():
        assert f"--{flag}" in done.stdout
