"""A GGUF without an mmproj: its picture travels and is decoded, and every result says that it is not seen."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import s2a_bench as s2a
from s2a_bench.boards.profile import load_profile
from s2a_bench.inference.models import tiny_dummy
from s2a_bench.store.run import read_run
from tests.cli.program import called, printed
from tests.cli.program import only_run as only

FEW = ("--size", "64x48", "--max-tokens", "4", "--requests", "2", "--warmup", "1", "--threads", "1", "--data-only")
UNSEEN, UNSENT = "picture not seen", "picture not seen or sent"
THEIRS = "http/llama-server"
CELLS = {"http/binary": UNSEEN, "http/as-deployed?payload=jpeg": UNSEEN} | (
    {THEIRS: UNSENT} if find_spec("xllamacpp") else {}
)
LLAMA_SERVER = pytest.mark.skipif(THEIRS not in CELLS, reason="the wheel xllamacpp is not installed")


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny dummy's language model alone."""
    model = tmp_path_factory.mktemp("model") / "texts.gguf"
    model.symlink_to(tiny_dummy()[0])
    return model


@pytest.fixture(scope="module")
def blind(texts: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What latency prints of our servers, and of llama.cpp's own where it is installed."""
    folder = tmp_path_factory.mktemp("blind")
    done = called("latency", "--transport", ",".join(CELLS), "--model", texts, *FEW, "--json", "--output", folder)
    found: dict[str, Any] = printed(done)
    return found


def test_the_picture_travels_and_is_decoded_and_the_manifest_says_that_it_is_not_seen(blind: dict[str, Any]) -> None:
    run = read_run(Path(blind["run"]))
    assert (run.samples["error"] == "").all()
    assert {cell: each.unseen for cell, each in run.origins.cells.items()} == CELLS
    samples = run.samples[run.samples["cell"] == "http/binary"]
    assert (samples["payload_bytes"] == 64 * 48 * 3).all()
    assert (samples["rgb_engine"] == samples["rgb_source"]).all()
    assert run.origins.of("http/binary").pictures == "not seen"
    model = run.manifest["model"]
    assert model["pictures"] == "not seen"
    assert not {"mmproj", "mmproj_sha256", "projector"} & model.keys()


@LLAMA_SERVER
def test_llama_server_refuses_pictures_then_so_it_gets_none_and_is_compared_by_its_tokens(
    blind: dict[str, Any], texts: Path, tmp_path: Path
) -> None:
    run = read_run(Path(blind["run"]))
    theirs = run.samples[run.samples["cell"] == THEIRS]
    assert theirs["image_encode_ns"].isna().all()
    assert run.samples["prompt_n"].nunique() == 1  # all evaluate the same
    assert not blind["ratios"]
    server = next(each for each in run.manifest["servers"].values() if "version" in each)
    assert server["engine"]["pictures"] == blind["provenance"]["cells"][THEIRS]["pictures"]
    assert not {"mmproj", "mmproj_sha256"} & server["engine"].keys()
    flags = ("--engine", "llama-server", "--model", texts, *FEW, "--payload", "jpeg")
    done = called("throughput", *flags, "--output", tmp_path)
    assert UNSEEN.upper() in " ".join(done.stdout.split())
    table = s2a.load(only(tmp_path).path).table("ratios")
    assert {*table["metric"]} >= {"tokens_per_s"}


def test_a_profile_of_it_says_so_and_so_do_what_it_computes_and_its_replay(
    texts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ("--requests", "14", "--warmup", "1", "--tokens", "4", "--size", "64x48", "--threads", "1")
    monkeypatch.chdir(tmp_path)
    done = called("profile", "capture", "blind", "--model", texts, *few)
    assert f"(measured, dummy weights, {UNSEEN})" in done.stdout
    assert load_profile("blind").facts["model"]["pictures"] == "not seen"
    assert "picture not seen" in " ".join(called("profile", "list").stdout.split())
    computed = s2a.timeline(profiles=["blind"], tokens_per_skill=[4], output=tmp_path / "runs")
    drawn = s2a.chunks(latency=["blind"], modes="sync", cycles=100, output=tmp_path / "runs")
    played = s2a.latency(transports=["loopback"], engine="replay", profile="blind", size="64x48", requests=1, warmup=0)
    for run in (computed, drawn, played):
        assert UNSEEN in read_run(run.path).origins.labels, run
        assert UNSEEN.upper() in run._repr_html_(), run
