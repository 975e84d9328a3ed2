"""llama.cpp's own server, out of the wheel: the baseline of the paper as a cell of a run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from s2a_bench.inference.models import tiny_dummy
from tests.cli.program import called, only_run, printed, refused

pytestmark = pytest.mark.skipif(find_spec("xllamacpp") is None, reason="the wheel xllamacpp is not installed")

SMALL = ("--size", "64x48", "--max-tokens", "4", "--requests", "2", "--warmup", "1", "--threads", "1", "--data-only")
CLOSED = [f"http/llama-server?connection={kind}" for kind in ("per-request", "client-per-request")]
"""Connections that are closed after each answer."""


def test_it_is_measured_beside_our_own_cells_whose_port_it_does_not_take(tmp_path: Path) -> None:
    cells = ("http/llama-server", *CLOSED, "http/as-deployed", "loopback")
    done = called("latency", *SMALL, "--transport", ",".join(cells), "--port", "18471", "--output", tmp_path)
    run = only_run(tmp_path)
    assert {*cells} <= set(run.samples["cell"])
    assert (run.samples["error"] == "").all()
    theirs = run.samples[run.samples["cell"] == "http/llama-server"]
    assert theirs["ingest_ns"].notna().all()
    assert run.samples["e2e_without_model_ns"].notna().all()
    assert set(theirs["engine"]) == {"llama-server"}
    assert (theirs["cache_n"] == 0).all()
    assert run.origins.of("http/llama-server").weights == "dummy"
    server = next(each for each in run.manifest["servers"].values() if "version" in each)
    assert server["version"].startswith("xllamacpp ")
    native = next(each for each in run.manifest["servers"].values() if "version" not in each)
    assert native["address"].endswith(":18471")
    assert server["told"]["flash_attention"] == native["engine"]["flash_attention"] == "auto"
    assert "http/llama-server" in done.stdout


def test_throughput_lets_it_answer_in_turn_with_our_engine_and_both_obey_a_grammar(tmp_path: Path) -> None:
    grammar = tmp_path / "g.gbnf"
    grammar.write_text('root ::= "go"+\n')
    output = tmp_path / "runs"
    flags = ("--engine", "llama-server", "--grammar", str(grammar))
    whole = printed(called("throughput", *SMALL, *flags, "--json", "--output", output))
    theirs, native = sorted(whole["cells"], key=lambda cell: str(cell["engine"]), reverse=True)
    assert [(cell["cell"], cell["engine"], cell["t_eval"], cell["errors"]) for cell in (native, theirs)] == [
        ("in-process", "llama", "engine", 0),
        ("http/llama-server", "llama-server", "engine", 0),
    ]
    assert {(ratio["metric"], ratio["of"], ratio["to"]) for ratio in whole["ratios"]} >= {
        ("tokens_per_s", "http/llama-server", "in-process")
    }
    run = only_run(output)
    assert run.manifest["configuration"]["transports"] == ["in-process", "http/llama-server"]
    (server,) = run.manifest["servers"].values()
    assert (run.manifest["model"]["engine"], run.manifest["model"]["sampling"]) == ("llama", "model")
    assert run.manifest["model"]["model_sha256"] == server["engine"]["model_sha256"]
    assert set("".join(run.tokens["text"].dropna())) <= {"g", "o"}


def test_a_projector_that_is_none_is_one_line(tmp_path: Path) -> None:
    model, _ = tiny_dummy()
    arguments = ("--transport", "http/llama-server", "--model", str(model), "--mmproj", str(model))
    assert "error: " in called("latency", *SMALL, *arguments, "--output", tmp_path, code=1).stderr


@pytest.mark.parametrize("cell", ["http/llama-server", "loopback"])
def test_layers_on_a_gpu_that_a_build_cannot_use_are_refused(cell: str, tmp_path: Path) -> None:
    if any("CPU" not in device["type"].name for device in pytest.importorskip("xllamacpp").get_device_info()):
        pytest.skip("a GPU is here")
    output = refused("latency", *SMALL, "--output", tmp_path, "--transport", cell, "--gpu-layers", "-1")
    assert "error: --gpu-layers: " in output
    assert "is built for the CPU alone" in output
