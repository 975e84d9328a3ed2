"""A package of somebody else's adds one of each kind, installed as theirs would be, and nothing here knows of it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "tests" / "plugin_example"
Command = Callable[..., subprocess.CompletedProcess[str]]
SMALL = ("--size", "64x48", "--requests", "6", "--warmup", "1", "--engine", "echo", "--max-tokens", "3")


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Install the package offline into a folder of its own; return the environment in which Python finds it."""
    pytest.importorskip("setuptools", reason="builds the package")
    source = tmp_path_factory.mktemp("source") / "plugin"
    subprocess.run(["cp", "-r", str(PACKAGE), str(source)], check=True)  # building writes beside the sources
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(target), str(source)], check=True, timeout=120)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(target), str(ROOT), os.environ.get("PYTHONPATH", "")])}


def command_in(folder: Path, installed: dict[str, str]) -> Command:
    """Return what runs s2a-bench with the package there, in a folder."""

    def run(*args: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "s2a_bench", *args]
        done = subprocess.run(line, capture_output=True, text=True, check=False, env=installed, cwd=folder, timeout=240)
        assert done.returncode == code, done.stderr
        return done

    return run


@pytest.fixture
def command(installed: dict[str, str], tmp_path: Path) -> Command:
    return command_in(tmp_path, installed)


def folder_of(done: subprocess.CompletedProcess[str], tmp_path: Path) -> Path:
    """Return the run folder of a command, the newest."""
    assert "Traceback" not in done.stderr
    return max((tmp_path / "results").iterdir(), key=lambda path: path.stat().st_mtime_ns)


@pytest.fixture(scope="module")
def measured(installed: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Measure the toy transport beside loopback, with its camera."""
    place = tmp_path_factory.mktemp("measured")
    done = command_in(place, installed)("latency", "--transport", "toy,loopback", "--source", "toy-stripes", *SMALL)
    assert "toy_frame" in done.stdout
    folder = folder_of(done, place)
    assert "ratio to" in (folder / "tables" / "summary.md").read_text()
    return folder


def test_its_tests_are_the_shipped_suites(installed: dict[str, str]) -> None:
    line = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(PACKAGE), "-c", os.devnull]
    line += ["--import-mode=importlib", str(PACKAGE / "tests")]
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=installed, cwd=PACKAGE, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:]
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None
    assert int(passed[1]) > 30


def test_what_it_adds_is_measured_compared_and_reported(measured: Path, command: Command, tmp_path: Path) -> None:
    samples = pd.read_csv(measured / "samples.csv")
    toy, loopback = (samples[samples["cell"] == name] for name in ("toy", "loopback"))
    assert (toy["toy_frame_ns"] > 0).all()
    assert (toy["toy_unframe_ns"] > 0).all()
    assert (toy["rgb_source"] == toy["rgb_engine"]).all()
    assert loopback["toy_frame_ns"].isna().all()
    assert {json.loads(facts)["toy_messages"] for facts in toy["facts"]} == {4.0}
    stages = pd.read_csv(measured / "tables" / "stages.csv")
    assert set(stages[stages["stage"] == "toy_frame"]["group"]) == {"pack"}
    ratios = pd.read_csv(measured / "tables" / "ratios.csv")
    assert {("toy", "loopback")} == set(zip(ratios["of"], ratios["to"], strict=True))
    assert (measured / "figures" / "stages.png").exists()
    assert "| toy_messages | messages | 4.00 |" in (measured / "tables" / "facts.md").read_text()
    manifest = json.loads((measured / "manifest.json").read_text())
    assert manifest["facts"]["toy_messages"] == {"unit": "messages", "about": "messages of the answer"}

    done = command("latency", "--transport", "toy,loopback", *SMALL, "--json")
    assert "toy_frame" in json.loads(done.stdout)["cells"][0]["stages_ms"]
    again = folder_of(done, tmp_path)
    flags = ("--unlike", "--metric", "toy_frame", "--json")
    whole = json.loads(command("compare", str(measured), str(again), *flags).stdout)
    assert {comparison["cell"] for comparison in whole["comparisons"]} == {"toy"}
    command("report", str(measured), "--output", "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "toy_frame" in page
    assert "toy_messages" in page


def test_an_option_of_its_transport_is_part_of_the_name(command: Command) -> None:
    done = command("latency", "--transport", "toy?toy_port=70000", *SMALL, code=2)
    assert "--toy-port: '70000' should be less than or equal to 65535" in done.stderr
    done = command("latency", "--transport", "toy?speed=9", *SMALL, code=2)
    assert re.search(r"speed.*toy_port", done.stderr)


def test_its_server_runs_by_name(installed: dict[str, str], tmp_path: Path) -> None:
    line = [sys.executable, "-m", "s2a_bench", "serve", "toy", "--engine", "echo"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=installed, cwd=tmp_path) as server:
        assert server.stdout is not None
        line = server.stdout.readline()
        server.terminate()
        assert server.wait(20) == 0
    assert re.search(r"toy at 127\.0\.0\.1:\d+; engine echo", line)


def test_its_policy_takes_its_parameter(command: Command) -> None:
    args = ("timeline", "--profile", "jetson-agx-orin", "--tokens-per-skill", "6", "--json")
    cells = {
        policy: json.loads(command(*args, "--policy", policy).stdout)["cells"][0]
        for policy in ("wait-then-act", "toy-policy?factor=1", "toy-policy?factor=4")
    }
    assert cells["toy-policy?factor=1"]["start_s"] == cells["wait-then-act"]["start_s"]
    assert cells["toy-policy?factor=4"]["start_s"] < cells["wait-then-act"]["start_s"]
    assert cells["toy-policy?factor=4"]["policy"] == "toy-policy?factor=4"
    assert "1 or more" in command(*args, "--policy", "toy-policy?factor=0.5", code=2).stderr


def test_its_policy_is_calibrated_and_tracked(command: Command, tmp_path: Path) -> None:
    args = ("timeline", "--profile", "jetson-orin-nano", "--tokens-per-skill", "4", "--jitter", "profile")
    args += ("--plans", "30", "--calibration-plans", "99", "--policy", "toy-careful,naive", "--json")
    done = command(*args)
    cells = {cell["policy"]: cell for cell in json.loads(done.stdout)["cells"]}
    (found,) = json.loads((folder_of(done, tmp_path) / "manifest.json").read_text())["calibrations"].values()
    assert found["plans"] == 99
    assert found["caution"] > 0
    assert cells["toy-careful"]["caution"] == found["caution"]
    assert cells["toy-careful"]["p_any_stall"] < cells["naive"]["p_any_stall"]
    assert json.loads(command(*args, "--track").stdout)["cells"]


def test_its_mode_has_its_trigger_learnt(command: Command, tmp_path: Path) -> None:
    args = (
        "chunks",
        "--modes",
        "toy-mode?trigger=2",
        "--latency",
        "lognormal:mean_ms=90,cv=0.3",
        "--cycles",
        "300",
    )
    done = command(*args, "--calibration-cycles", "200", "--json")
    rows = {cell["rule"]: cell for cell in json.loads(done.stdout)["cells"]}
    assert set(rows) == {"given", "calibrated", "tracked", "maximum", "mean", "oracle"}
    assert {cell["mode"] for rule, cell in rows.items() if rule != "given"} == {"toy-mode"}
    assert rows["given"]["trigger"] == 2
    assert rows["calibrated"]["trigger"] > rows["mean"]["trigger"] > 2
    assert rows["calibrated"]["p_stall_cycle"] < 0.05 < rows["given"]["p_stall_cycle"]
    triggers = pd.read_csv(folder_of(done, tmp_path) / "chunk_triggers.csv")
    assert set(triggers["mode"]) == {"toy-mode"}
    assert triggers["p_stall_cycle"].is_monotonic_decreasing


def test_its_engine_answers_over_any_transport(command: Command, tmp_path: Path) -> None:
    args = [*SMALL]
    args[args.index("echo")] = "toy-words"
    done = command("latency", "--transport", "http,toy", *args)
    folder = folder_of(done, tmp_path)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["provenance"]["run"]["engine"] == "toy-words"
    assert manifest["facts"]["toy_counted"]["unit"] == "words"
    samples = pd.read_csv(folder / "samples.csv")
    assert {json.loads(facts)["toy_counted"] for facts in samples[samples["cell"] != "toy"]["facts"]} == {3.0}
    assert "Toy-words engine" in done.stdout
    assert "computes nothing" in command("throughput", "--engine", "toy-words", code=2).stderr
    assert "for an engine with a model" in command("latency", *args, "--gpu-layers", "1", code=2).stderr


def test_its_robot_gets_the_actions_of_its_engine_in_its_mode(command: Command, tmp_path: Path) -> None:
    args = (
        "chunks",
        "--live",
        "--transport",
        "loopback",
        "--engine",
        "toy-words",
        "--size",
        "64x48",
        "--seconds",
        "1",
    )
    args += ("--modes", "toy-mode?trigger=2", "--rules", "maximum", "--horizon", "8", "--control-hz", "50")
    done = command(*args, "--robot", "toy-robot?log=actions.txt", "--json")
    rows = {cell["rule"]: cell for cell in json.loads(done.stdout)["cells"]}
    assert set(rows) == {"given", "maximum"}
    assert not any("agreement" in cell for cell in rows.values())  # the mode has no arrays to check it by
    lines = (tmp_path / "actions.txt").read_text().splitlines()
    assert sum(line.startswith("action ") for line in lines) > 50
    assert json.loads((folder_of(done, tmp_path) / "manifest.json").read_text())["robot"] == {"robot": "toy-robot"}
    assert "--robot is an option of mode live" in command("chunks", "--robot", "toy-robot", code=2).stderr


def test_its_robot_carries_out_skills(command: Command, tmp_path: Path) -> None:
    args = ("timeline", "--live", "--engine", "replay", "--profile", "rtx-4080", "--transport", "loopback")
    command(*args, "--n-skills", "2", "--t-nom", "0.05", "--policy", "naive", "--robot", "toy-robot?log=skills.txt")
    assert len((tmp_path / "skills.txt").read_text().splitlines()) == 2


def test_its_world_is_driven(command: Command) -> None:
    drive = ("ccrb", "--skills", "3", "--policy", "naive", "--json")
    late, exact = (
        json.loads(command(*drive, "--simulator", each).stdout)["cells"][0] for each in ("toy-world", "longitudinal")
    )
    assert late["outcome"] == exact["outcome"]
    assert 0 < abs(late["min_front_gap_m"] - exact["min_front_gap_m"]) < 1
    one_lane = command("ccrb", "--simulator", "toy-world", "--lane-change", code=2).stderr
    assert "--lane-change: the toy-world simulator knows one lane" in one_lane


def test_its_experiment_is_a_command_and_a_function(
    command: Command, installed: dict[str, str], tmp_path: Path
) -> None:
    assert "toy-clock" in command("--help").stdout
    assert "--readings" in command("toy-clock", "--help").stdout
    assert "cost of a reading (ns), median" in command("toy-clock", "--readings", "50").stdout
    done = command("toy-clock", "--readings", "50", "--json")
    (cell,) = json.loads(done.stdout)["cells"]
    assert cell["cost"]["n"] == 50
    assert "--readings: 0 should be" in command("toy-clock", "--readings", "0", code=2).stderr
    one, other = sorted((tmp_path / "results").iterdir())
    assert json.loads(command("compare", str(one), str(other), "--json").stdout)["comparisons"]
    command("report", str(one), "--output", str(tmp_path / "report.html"))
    page = (tmp_path / "report.html").read_text()
    assert "cost of a reading" in page
    assert "Bars are readings, end to end." in page
    assert page.count('<rect class="skill"') == 20
    code = "from s2a_bench import library; print(len(library.run('toy-clock', readings=7).table('readings')))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=installed, cwd=tmp_path
    )
    assert done.stdout.strip() == "1", done.stderr


def test_a_package_that_does_not_load_is_one_line_and_spoils_no_other_command(
    installed: dict[str, str], tmp_path: Path
) -> None:
    broken = tmp_path / "site" / "s2a_broken-1.0.dist-info"
    broken.mkdir(parents=True)
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: s2a-broken\nVersion: 1.0\n")
    kinds = ("transports", "experiments", "policies", "dialects", "engines", "frame_sources", "middlewares")
    kinds += ("surroundings", "commands", "references")
    (broken / "entry_points.txt").write_text(
        "".join(f"[s2a_bench.{kind}]\nbroken = s2a_broken:THING\n" for kind in kinds)
        + "[s2a_bench.commands]\nlost = s2a_broken:THING\ndoctor = s2a_bench.transport.defaults:BESIDE\n"
    )
    environment = installed | {"PYTHONPATH": f"{broken.parent}{os.pathsep}{installed['PYTHONPATH']}"}

    def run(*args: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "s2a_bench", *args]
        return subprocess.run(
            line, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path, timeout=120
        )

    assert "Check this machine" in run("--help").stdout  # the name of a command that there is counts for nothing
    assert run("boundary", "--points", "3").returncode == 0
    for args in (("broken",), ("lost",), ("latency", "--against", "broken"), ("timeline", "--policy", "broken")):
        done = run(*args)
        assert done.returncode == 2
        assert "the package s2a-broken does not load: ModuleNotFoundError" in done.stderr
        assert "Traceback" not in done.stderr


def test_nothing_here_knows_of_it() -> None:
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    names = {name for points in project["entry-points"].values() for name in points} | {"s2a_toy", "toy_"}
    for path in (ROOT / "s2a_bench").rglob("*.py"):
        text = path.read_text()
        mentioned = {name for name in names - {"toy"} if name in text}
        assert not mentioned, f"{path} mentions {mentioned}"
        assert '"toy"' not in text
