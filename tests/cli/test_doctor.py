"""`s2a-bench doctor`, and sampling beside a run, as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from typer.testing import CliRunner

from s2a_bench.cli import app
from s2a_bench.machine.doctor import Finding, Level
from s2a_bench.machine.resources import RESOURCES
from tests.cli.program import called, only_run, printed
from tests.made_runs import SCHEMA

SMALL = ["--size", "64x48", "--requests", "4", "--warmup", "1", "--data-only"]
ECHO = ["latency", "--engine", "echo", *SMALL]


def test_json_is_one_object_that_the_schema_describes() -> None:
    facts = printed(called("doctor", "--json"))
    assert facts["command"] == "doctor"
    for key in ("checks", "worst"):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({name: value for name, value in facts.items() if name != key}, SCHEMA)
    levels = {check["code"]: check["level"] for check in facts["checks"]}
    assert {warning["code"] for warning in facts["warnings"]} == {
        code for code, level in levels.items() if level in {"warning", "error"}
    }


@pytest.mark.parametrize(
    ("level", "plain", "strict"), [("state", 0, 0), ("advice", 0, 0), ("warning", 0, 1), ("error", 1, 1)]
)
def test_the_exit_code_is_the_severitys(level: Level, plain: int, strict: int, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [Finding("disk", "state", "room"), Finding("load", level, "busy", "wait")]
    monkeypatch.setattr("s2a_bench.cli.doctor.examine", lambda _machine, _checks: found)
    for flags, code in (([], plain), (["--strict"], strict)):
        assert CliRunner().invoke(app, ["doctor", *flags]).exit_code == code
    shown = CliRunner().invoke(app, ["doctor"]).stdout
    assert f"{level:8}load  busy -> wait" in shown.splitlines()


def test_a_run_samples_resources_and_says_what_that_cost(tmp_path: Path) -> None:
    flags = ("--transport", "http,loopback", "--latency", "50", "--verbose", "--sample-resources", "50")
    done = called(*ECHO, *flags, "--output", tmp_path)
    assert "sampling takes" in done.stdout
    run = only_run(tmp_path)
    resources = run.manifest["resources"]
    assert resources["hz"] == 50
    assert {"cpu", "memory"} <= resources["readers"].keys()
    assert resources["polls"] >= 1
    assert resources["core_share"] > 0
    for cell, facts in zip(run.samples["cell"], run.samples["facts"], strict=True):
        spent = json.loads(facts)
        assert spent["client_cpu_ns"] > 0
        assert spent["server_cpu_ns"] >= (0 if cell == "loopback" else 1)
        assert spent["client_rss_bytes"] > 1 << 20
    table = run.table(RESOURCES)
    assert set(table["reader"]) == set(resources["readers"])
    edges = table[table["reader"] == "cpu"]["client_cpu_ns"]
    assert edges.is_monotonic_increasing
    assert len(edges) >= 2 * len(run.samples)


def test_sampling_can_be_left_out(tmp_path: Path) -> None:
    called(*ECHO, "--transport", "loopback", "--sample-resources", "0", "--output", tmp_path)
    run = only_run(tmp_path)
    assert run.manifest["resources"] == {}
    assert not list(run.path.glob("resources*"))
    assert not any("cpu" in facts for facts in run.samples["facts"])
