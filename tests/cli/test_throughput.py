"""`s2a-bench throughput` as a user runs it: the tiny model, real servers, and a stand-in for llama-bench."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from s2a_bench.experiments.throughput.metrics import REFERENCE
from tests.cli.program import called, only_run, printed
from tests.llama_bench_stand_in import install

SMALL = ["--size", "64x48", "--requests", "2", "--warmup", "1", "--max-tokens", "40", "--threads", "1"]
REAL = "S2A_BENCH_LLAMA_BENCH"
"""Names the real llama-bench, for the test that needs it."""


def run(*arguments: str, output: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return called("throughput", *arguments, "--output", output, code=code)


@pytest.mark.slow
def test_in_process_http_and_ros_stand_beside_llama_bench(tmp_path: Path) -> None:
    program = install(tmp_path)
    everywhere = ["--transport", "in-process,http,ros", "--payload", "raw"]
    done = run(*SMALL, *everywhere, "--reference", str(program), "--json", output=tmp_path / "r")
    whole = printed(done)
    assert whole["command"] == "throughput"
    assert [cell["cell"] for cell in whole["cells"]] == ["in-process", "http/as-deployed", "ros/topic"]
    for cell in whole["cells"]:
        assert (cell["n"], cell["warmups"], cell["errors"], cell["t_eval"]) == (2, 1, 0, "engine")
        assert cell["itl_ms"]["n"] == 2 * 39
        assert {"vision_encode_ms", "prompt_eval_ms", "first_decode_ms", "ttft_ms"} <= set(cell)
        assert [place["first"] for place in cell["positions"]] == [0, 32]
    compared = {(ratio["of"], ratio["to"]) for ratio in whole["ratios"]}
    assert compared == {
        ("in-process", "llama-bench"),
        ("http/as-deployed", "llama-bench"),
        ("ros/topic", "llama-bench"),
        ("http/as-deployed", "in-process"),
        ("ros/topic", "in-process"),
    }
    assert whole["reference"]["decode_tokens_per_s"]["mean"] == pytest.approx(1000)
    kept = only_run(tmp_path / "r")
    prompts = set(kept.samples["prompt_n"])
    assert len(prompts) == 1
    assert set(kept.table(REFERENCE)["depth"]) == prompts  # like with like: as deep as our prompts are long
    assert whole["reference"]["depths"] == [int(next(iter(prompts)))]
    assert kept.manifest["configuration"]["engine"]["sampling"] == "greedy"
    answers = kept.tokens.groupby("request_id")["text"].apply("".join).groupby(lambda name: name.rsplit("-", 1)[1])
    assert (answers.nunique() == 1).all()  # the same frame, the same greedy answer in every cell of a block
    assert len(kept.tokens) == 9 * 40
    assert kept.samples["frame_index"].nunique() > 1


@pytest.mark.slow
def test_both_ways_of_flash_attention_are_cells_of_one_run(tmp_path: Path) -> None:
    ways = ["--transport", "in-process,http", "--flash-attention", "off,on"]
    whole = printed(run(*SMALL, *ways, "--json", output=tmp_path))
    names = [f"{path}?flash_attention={way}" for path in ("in-process", "http/as-deployed") for way in ("off", "on")]
    assert [(cell["cell"], cell["n"], cell["errors"]) for cell in whole["cells"]] == [(name, 2, 0) for name in names]
    compared = [(ratio["of"], ratio["to"]) for ratio in whole["ratios"]]
    assert compared == [(names[1], names[0]), (names[2], names[0]), (names[3], names[1])]  # like with like
    manifest = only_run(tmp_path).manifest
    assert [server["engine"]["flash_attention"] for server in manifest["servers"].values()] == ["off", "on"]
    assert "flash_attention" not in manifest["model"]  # it has no one value


@pytest.mark.skipif(REAL not in os.environ, reason=f"{REAL} does not name llama.cpp's llama-bench")
def test_the_real_llama_bench_understands_what_it_is_asked(tmp_path: Path) -> None:
    settings = ["--kv-type", "q8_0", "--batch", "64", "--reference", os.environ[REAL]]
    reference = printed(run(*SMALL, *settings, "--json", output=tmp_path))["reference"]
    assert reference["decode_tokens_per_s"]["n"] == 2
    facts = json.loads(only_run(tmp_path).table(REFERENCE)["facts"].iloc[0])
    assert (facts["n_batch"], facts["type_k"], facts["n_threads"], facts["n_gpu_layers"]) == (64, "q8_0", 1, 0)
