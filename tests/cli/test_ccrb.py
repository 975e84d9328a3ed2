"""`s2a-bench ccrb` as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "docs" / "schema" / "s2a-bench-1.json").read_text())


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "s2a_bench", "ccrb", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)


def test_json_is_one_object_that_the_schema_describes(tmp_path: Path) -> None:
    done = run("--json", "--ttc", "--random", "12", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    whole = json.loads(done.stdout)
    jsonschema.validate(whole, SCHEMA)
    outcomes = {cell["policy"]: cell["outcome"] for cell in whole["cells"]}
    assert outcomes == {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none", "s2a-ttc": "none"}
    assert [study["gap_behaviour"] for study in whole["studies"]] == ["stop", "coast", "hold", "cruise"]
    assert "stay 1 m behind" in whole["follower_law"]
    folder = Path(whole["run"])
    for name in (
        "rollouts.parquet",
        "trajectories.parquet",
        "skills.csv",
        "figures/scenario.png",
        "tables/outcomes.md",
    ):
        assert (folder / name).stat().st_size > 0, name


def test_tables_name_the_law_and_what_is_emulated(tmp_path: Path) -> None:
    done = run("--rate", "9", "--prompt-time", "0.2", "--follower", "idm", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    for text in ("EMULATED: no model answered", "Rear: IDM follower", "does 'stop'", "S_front", "run folder:"):
        assert text in done.stdout


def test_the_animation_has_frames_of_the_right_size(tmp_path: Path) -> None:
    import cv2
    from PIL import Image

    done = run("--animation", "--json", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    figures = Path(json.loads(done.stdout)["run"]) / "figures"
    with Image.open(figures / "scenario.gif") as gif:
        assert gif.n_frames > 50  # type: ignore[attr-defined]
        gif.seek(gif.n_frames - 1)  # type: ignore[attr-defined]
        colours = gif.convert("RGB").getcolors(1 << 20) or []
        size = gif.size
    near_red = sum(count for count, (red, green, blue) in colours if red > 190 and green < 120 and blue < 60)
    assert near_red > 1000  # two pairs of cars have crashed
    film = cv2.VideoCapture(str(figures / "scenario.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == size
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > 100


@pytest.mark.slow
def test_a_live_run_prints_one_object_and_leaves_a_whole_folder(tmp_path: Path) -> None:
    flags = ("--live", "--transport", "loopback", "--pace", "40", "--threads", "1", "--skills", "3", "--ttc")
    done = run(*flags, "--json", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    whole = json.loads(done.stdout)
    jsonschema.validate(whole, SCHEMA)
    assert [cell["policy"] for cell in whole["cells"]] == ["naive", "wait-then-act", "stream-to-act", "s2a-ttc"]
    assert {(cell["emulated"], cell["profile"]) for cell in whole["cells"]} == {(False, None)}
    assert (whole["live"]["transport"], whole["live"]["paced_tokens_per_s"]) == ("loopback", 40.0)
    folder = Path(whole["run"])
    for name in ("figures/scenario.png", "tables/outcomes.md", "samples.csv", "tokens.csv"):
        assert (folder / name).stat().st_size > 0, name
    assert "LIVE tokens over loopback, paced to 40 tokens/s" in (folder / "tables" / "outcomes.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--simulator", "gazebo"], 2, "--simulator: 'gazebo' is none of longitudinal, embedded, carla"),
        (["--phase-gaps", "6"], 2, "--phase-gaps: should be two numbers"),
        (["--phase-rates", "a,b"], 2, "--phase-rates: 'a' should be a valid number"),
        (["--openscenario", "x.txt"], 2, "--openscenario: x.txt should end in .xosc"),
        (["--lane-change"], 2, "--lane-change: the longitudinal simulator knows one lane"),
        (["--simulator", "carla", "--host", "localhost:1"], 1, "carla"),
        (["--pace", "4.8"], 2, "--pace is about a model that answers; it needs --live"),
        (["--transport", "ros"], 2, "--transport is about a model that answers; it needs --live"),
        (["--live", "--rate", "9"], 2, "--rate is about tokens that are modelled; leave it out with --live"),
        (["--live", "--prompt-time", "0.2"], 2, "--prompt-time is about tokens that are modelled"),
        (["--live", "--profile", "rtx-4080"], 2, "--profile is about tokens that are modelled"),
        (["--live", "--phase"], 2, "--phase is about tokens that are modelled; leave it out with --live"),
        (["--live", "--random", "9"], 2, "--random is about tokens that are modelled; leave it out with --live"),
        (["--live", "--openscenario", "x.xosc"], 2, "--openscenario is about tokens that are modelled"),
        (["--live", "--pace", "-1"], 2, "--pace: -1.0 should be greater than 0"),
        (["--live", "--pace", "0.01"], 2, "the whole plan takes"),
        (["--live", "--transport", "pigeon"], 2, "--transport: 'pigeon' is none of http, ros, loopback"),
        (["--live", "--engine", "echo"], 2, "--engine echo writes no plans"),
        (["--live", "--engine", "replay", "--pace", "5"], 2, "--engine replay has its profile's rate"),
        (["--live", "--engine", "replay", "--tokens-per-skill", "4"], 2, "--engine replay writes 6 tokens a skill"),
    ],
)
def test_wrong_use_is_one_line(arguments: list[str], code: int, message: str, tmp_path: Path) -> None:
    done = run(*arguments, "--output", str(tmp_path))
    assert done.returncode == code
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert message in lines[0]
    assert "Traceback" not in done.stderr
