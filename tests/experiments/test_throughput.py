"""The options of a throughput run, its rounds, and the reference."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.errors import EngineError, UsageError
from s2a_bench.experiments.throughput.config import ThroughputConfig
from s2a_bench.experiments.throughput.metrics import REFERENCE
from s2a_bench.experiments.throughput.run import llama_bench
from s2a_bench.harness.plan import BlocksPlan, RunPlan, resolve
from s2a_bench.harness.processes import llama_flags
from s2a_bench.harness.rounds import run_blocks
from s2a_bench.harness.session import Place
from s2a_bench.inference import EngineConfig
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.testing import NullProgress
from tests.llama_bench_stand_in import install

REQUESTS = ThroughputConfig(max_tokens=16)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"grammar": 'root ::= "a"'}, "llama-bench knows no grammar"),
        ({"engine": EngineConfig(name="replay", profile="jetson-orin-nano")}, "leave out `engine` replay"),
        ({"engine": {"flash_attention": "on,off"}}, "one `flash_attention` at a time"),
    ],
)
def test_a_reference_needs_what_llama_bench_can_do(tmp_path: Path, fields: dict[str, Any], message: str) -> None:
    program = install(tmp_path)
    REQUESTS.but(reference=program)
    with pytest.raises(UsageError) as error:
        REQUESTS.but(reference=program, **fields)
    assert message in str(error.value)
    for wrong in (tmp_path, tmp_path / "missing", Path(__file__)):
        with pytest.raises(UsageError, match=r"`reference`: .* is not an executable program"):
            REQUESTS.but(reference=wrong)


def test_the_engine_llama_server_is_llama_cpps_own_beside_ours() -> None:
    config = ThroughputConfig(
        engine={"name": "llama-server", "threads": 1}, options={"http": {"llama_server": sys.executable}}
    )
    assert [pipeline.name for pipeline in config.pipelines] == ["loopback", "http/llama-server"]
    assert (config.engine.name, config.engine.threads, config.greedy) == ("llama", 1, False)
    assert config.but(requests=3).pipelines == config.pipelines
    with pytest.raises(UsageError, match="`engine` llama-server is `transport` in-process,http/llama-server; leave"):
        ThroughputConfig(engine={"name": "llama-server"}, transports="ros")
    with pytest.raises(UsageError, match="`sampling` greedy is our own engine's; leave it out with `llama_server`"):
        ThroughputConfig(
            engine={"name": "llama-server", "sampling": "greedy"}, options={"http": {"llama_server": sys.executable}}
        )
    with pytest.raises(UsageError, match="'llamaserver' is not one of llama, echo, replay"):
        ThroughputConfig(engine={"name": "llamaserver"})


def test_several_ways_of_flash_attention_are_cells_with_servers_of_their_own() -> None:
    config = ThroughputConfig(engine={"flash_attention": "on, off"}, transports="in-process,http/binary")
    names = [f"{path}?flash_attention={way}" for path in ("loopback", "http/binary") for way in ("on", "off")]
    assert [cell.name for cell in config.pipelines] == names
    assert [dict(cell.engine)["flash_attention"] for cell in config.pipelines] == ["on", "off"] * 2
    assert len({cell.server for cell in config.pipelines}) == 4
    assert config.but(transports=names).pipelines == config.pipelines
    assert config.to_manifest()["pipelines"][names[3]]["flash_attention"] == "off"
    (one,) = ThroughputConfig(engine={"flash_attention": "off"}).pipelines
    assert (one.name, one.engine) == ("loopback", ())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"requests": 0}, "`requests`: 0"),
        (
            {"engine": {"sampling": "greedy"}, "transports": "http/best-effort?url=http://x"},
            "`sampling` greedy is our own engine's",
        ),
        ({"engine": {"flash_attention": "on,of"}}, "`flash_attention`: 'of' is not one of auto, on, off"),
        ({"engine": {"flash_attention": ""}}, "`flash_attention`: '' is not one of auto, on, off"),
        ({"transports": "in-process?flash_attention=x"}, "`flash_attention`: 'x' is not one of auto, on, off"),
        ({"engine": {"flash_attention": "on,off", "kv_type": "q8_0"}}, "`kv_type` q8_0 needs flash attention"),
        (
            {"engine": {"flash_attention": "on,off", "name": "replay", "profile": "rtx-4080"}},
            "`engine` replay knows no flash attention",
        ),
        (
            {"engine": {"flash_attention": "on,off"}, "transports": "http", "url": "http://x"},
            "`flash_attention`: the server of http/as-deployed?flash_attention=on runs already, as it was set",
        ),
    ],
)
def test_what_makes_no_sense_is_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        ThroughputConfig(**fields)
    assert message in str(error.value)


@given(st.integers(1, 4), st.integers(0, 2), st.integers(0, 2), st.integers(1, 6), st.integers(0, 99))
def test_every_block_gives_everyone_one_turn_and_the_others_are_last_at_first(
    n_turns: int, n_others: int, warmup: int, runs: int, seed: int
) -> None:
    seen: list[tuple[str, Place]] = []
    turns = [lambda place, name=f"turn{i}": seen.append((name, place)) for i in range(n_turns)]
    others = [lambda place, name=f"other{i}": seen.append((name, place)) for i in range(n_others)]
    progress = NullProgress()
    run_blocks(turns, others, BlocksPlan(runs, warmup, 1, seed), progress)
    everyone = {f"turn{i}" for i in range(n_turns)} | {f"other{i}" for i in range(n_others)}
    assert progress.expected == progress.done == len(everyone) * (warmup + runs)
    for block in range(warmup + runs):
        places = [(name, place) for name, place in seen if place.block == block]
        assert {name for name, _ in places} == everyone
        assert [place.position for _, place in places] == list(range(len(everyone)))
        assert {place.warmup for _, place in places} == {block < warmup}
    assert all(name.startswith("turn") for name, place in seen if place.block == 0 and place.position < n_turns)


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[RunWriter]:
    with RunWriter.create(tmp_path / "results", "throughput", {}) as writer:
        yield writer


def launch(plan: RunPlan, writer: RunWriter, *prompts: int) -> Any:
    """Return a launch whose sessions have had prompts of so many tokens."""
    return SimpleNamespace(plan=plan, writer=writer, sessions=[SimpleNamespace(prompt_n=each) for each in prompts])


def test_the_reference_computes_with_our_settings_behind_our_prompts_length(tmp_path: Path, writer: RunWriter) -> None:
    engine = EngineConfig(
        model=tmp_path / "m.gguf",
        threads=3,
        gpu_layers=-1,
        context=512,
        batch=1024,
        kv_type="q8_0",
        flash_attention="on",
    )
    program, plan = install(tmp_path), resolve(REQUESTS.but(engine=engine), print)
    llama_bench(program, launch(plan, writer, 250, 90), Place(0, 1, warmup=True))
    llama_bench(program, launch(plan, writer, 250, 260), Place(1, 0, warmup=False))
    writer.finish("finished")
    kept = read_run(writer.path)
    rows = kept.table(REFERENCE)
    assert list(rows["warmup"]) == [True, False]
    assert list(rows["block"]) == [0, 1]
    assert list(rows["depth"]) == [250, 260]
    assert list(rows["n_gen"]) == [16, 16]
    assert list(rows["decode_ns"]) == [16_000_000, 16_000_000]
    assert (rows["finished_ns"] > rows["started_ns"]).all()
    facts = json.loads(rows["facts"].iloc[0])
    assert facts["model_filename"] == str(tmp_path / "m.gguf")
    assert (facts["n_threads"], facts["n_gpu_layers"]) == (3, 999)
    assert (facts["n_batch"], facts["n_ubatch"]) == (512, 512)  # no more than the context, as llama.cpp has it
    assert (facts["type_k"], facts["type_v"]) == ("q8_0", "q8_0")
    assert facts["n_prompt"] == 0
    command = kept.manifest["reference"]["command"]
    assert command[command.index("--flash-attn") + 1] == "on"
    assert command[-2:] == ["--n-depth", "260"]


def test_without_threads_the_reference_has_those_of_this_process() -> None:
    flags = llama_flags(EngineConfig())
    assert flags[flags.index("--threads") + 1] == str(len(os.sched_getaffinity(0)))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("crash", "exit code 1: main: error: failed to load model 'x.gguf'"),
        ("illegal", "AMX does not work; compile it on this machine: nothing"),
        ("garbage", "not llama-bench's JSON"),
        ("empty", "not llama-bench's JSON"),
        ("old", "too old for --flash-attn auto"),
    ],
)
def test_a_reference_that_fails_says_so_in_one_line(
    tmp_path: Path, writer: RunWriter, monkeypatch: pytest.MonkeyPatch, fault: str, message: str
) -> None:
    monkeypatch.setenv("S2A_STAND_IN_FAULT", fault)
    program = install(tmp_path)
    with pytest.raises(EngineError) as error:
        llama_bench(program, launch(resolve(REQUESTS, print), writer, 0), Place(0, 0, warmup=False))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
