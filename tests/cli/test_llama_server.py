"""llama.cpp's own server, out of the wheel: the baseline of the paper as a cell of a run."""

from __future__ import annotations

import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest

from s2a_bench.inference.models import tiny_dummy
from tests.cli.program import only_run, printed, program, refused

pytestmark = pytest.mark.skipif(find_spec("xllamacpp") is None, reason="the wheel xllamacpp is not installed")

SMALL = ("--size", "64x48", "--max-tokens", "4", "--warmup", "1", "--data-only")


def latency(output: Path, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    return program("latency", *SMALL, "--requests", "3", "--output", output, *arguments, code=code)


def test_it_is_measured_beside_our_own_cells(tmp_path: Path) -> None:
    done = latency(tmp_path, "--transport", "http/llama-server,http/as-deployed,loopback")
    run = only_run(tmp_path)
    theirs = run.samples[run.samples["cell"] == "http/llama-server"]
    assert (theirs["error"] == "").all()
    assert theirs["ingest_ns"].notna().all()
    assert run.samples["e2e_without_model_ns"].notna().all()
    assert set(theirs["engine"]) == {"llama-server"}
    assert (theirs["cache_n"] == 0).all()
    assert run.origins.of("http/llama-server").weights == "dummy"
    server = next(each for each in run.manifest["servers"].values() if "version" in each)
    assert server["version"].startswith("xllamacpp ")
    native = next(each for each in run.manifest["servers"].values() if "version" not in each)
    assert server["told"]["flash_attention"] == native["engine"]["flash_attention"] == "auto"
    assert "http/llama-server" in done.stdout


def test_throughput_lets_it_answer_in_turn_with_our_engine(tmp_path: Path) -> None:
    few = (*SMALL, "--threads", "1", "--requests", "2", "--json", "--output", tmp_path)
    done = program("throughput", "--engine", "llama-server", *few)
    whole = printed(done)
    theirs, native = sorted(whole["cells"], key=lambda cell: str(cell["engine"]), reverse=True)
    assert [(cell["cell"], cell["engine"], cell["t_eval"], cell["errors"]) for cell in (native, theirs)] == [
        ("in-process", "llama", "engine", 0),
        ("http/llama-server", "llama-server", "engine", 0),
    ]
    assert {(ratio["metric"], ratio["of"], ratio["to"]) for ratio in whole["ratios"]} >= {
        ("tokens_per_s", "http/llama-server", "in-process")
    }
    manifest = only_run(tmp_path).manifest
    assert manifest["configuration"]["transports"] == ["in-process", "http/llama-server"]
    (server,) = manifest["servers"].values()
    assert (manifest["model"]["engine"], manifest["model"]["sampling"]) == ("llama", "model")
    assert manifest["model"]["model_sha256"] == server["engine"]["model_sha256"]


def test_a_grammar_is_obeyed(tmp_path: Path) -> None:
    grammar = tmp_path / "g.gbnf"
    grammar.write_text('root ::= "go"+\n')
    output = tmp_path / "runs"
    latency(output, "--transport", "http/llama-server", "--grammar", str(grammar))
    assert set("".join(only_run(output).tokens["text"].dropna())) <= {"g", "o"}


@pytest.mark.parametrize("connection", ["per-request", "client-per-request"])
def test_connections_that_are_closed_after_each_answer(tmp_path: Path, connection: str) -> None:
    latency(tmp_path, "--transport", "http/llama-server", "--connection", connection)
    assert (only_run(tmp_path).samples["error"] == "").all()


def test_a_projector_that_is_none_is_one_line(tmp_path: Path) -> None:
    model, _ = tiny_dummy()
    arguments = ("--transport", "http/llama-server", "--model", str(model), "--mmproj", str(model))
    assert "error: " in latency(tmp_path, *arguments, code=1).stderr


@pytest.mark.parametrize("cell", ["http/llama-server", "loopback"])
def test_layers_on_a_gpu_that_a_build_cannot_use_are_refused(cell: str, tmp_path: Path) -> None:
    if any("CPU" not in device["type"].name for device in pytest.importorskip("xllamacpp").get_device_info()):
        pytest.skip("a GPU is here")
    output = refused("latency", *SMALL, "--output", tmp_path, "--transport", cell, "--gpu-layers", "-1")
    assert "error: --gpu-layers: " in output
    assert "is built for the CPU alone" in output


def test_a_port_in_use_is_not_taken_for_it(tmp_path: Path) -> None:
    latency(tmp_path, "--transport", "http/llama-server,http/as-deployed", "--port", "18471")  # our own server's
