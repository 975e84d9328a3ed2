"""`model list`: known names, what is fetched, dummies, and what is damaged."""

import json
import sys
from pathlib import Path
from typing import Any

import huggingface_hub.constants
import jsonschema
import pytest
from gguf import GGUFReader
from typer.testing import CliRunner

from s2a_bench.cli.model import app
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.inference.model_list import ListedModel, listed
from s2a_bench.inference.models import HUB_MODELS, load_headers, tiny_dummy
from s2a_bench.testing.engine import ask, rgb_frame

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/s2a-bench-model-1.json").read_text())
COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture(autouse=True)
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two caches in which nothing is: ours, and the hub's."""
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))


def fetched(tmp_path: Path, repository: str, **files: bytes) -> Path:
    """Lay files into the hub's cache as its library does; ``_`` of a name stands for a dot or a hyphen."""
    folder = tmp_path / "hub" / f"models--{repository.replace('/', '--')}"
    snapshot = folder / "snapshots" / COMMIT
    for each in (folder / "blobs", folder / "refs", snapshot):
        each.mkdir(parents=True, exist_ok=True)
    (folder / "refs" / "main").write_text(COMMIT)
    for name, content in files.items():
        (folder / "blobs" / name).write_bytes(content)
        (snapshot / f"{name}.gguf").symlink_to(Path("../../blobs") / name)
    return snapshot


def rows() -> dict[str, ListedModel]:
    found = [*listed()]
    assert len({row.name for row in found}) == len(found)
    return {row.name: row for row in found}


def shown(*flags: str) -> str:
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["list", *flags])
    assert result.exit_code == 0, result.output
    return result.stdout


def as_json() -> list[dict[str, Any]]:
    whole = json.loads(shown("--json"))
    jsonschema.validate(whole, SCHEMA)
    assert whole["command"] == "model list"
    models: list[dict[str, Any]] = whole["models"]
    return models


def test_with_nothing_on_this_machine_the_known_names_are_listed_and_no_number_is() -> None:
    assert as_json() == [{"name": name, "state": "not here", "bytes": {}} for name in HUB_MODELS]
    table = shown()
    assert [line.split()[0] for line in table.splitlines() if "not here" in line] == list(HUB_MODELS)
    assert all(line.split("not here")[1].strip() == "" for line in table.splitlines() if "not here" in line)


def test_a_dummy_has_its_sizes_and_the_tokens_that_its_engine_evaluates(tiny: EngineConfig) -> None:
    model, mmproj = tiny_dummy()
    row = as_json()[-1]
    assert (row["name"], row["state"]) == (str(model), "dummy")
    assert row["bytes"] == {str(path): path.stat().st_size for path in (model, mmproj)}
    tensors = [tensor for path in (model, mmproj) for tensor in GGUFReader(path).tensors]
    assert row["parameters"] == sum(int(tensor.n_elements) for tensor in tensors)
    engine = open_engine(tiny)
    lengths = []
    for pictures in (1, 2):
        ask(engine, images=tuple(rgb_frame(width=640, height=480) for _ in range(pictures)))
        lengths.append(engine.facts["prompt_n"])
    engine.close()
    assert row["picture_tokens"] == lengths[1] - lengths[0]
    assert model.name in shown()


def test_fetched_models_are_listed_by_the_names_that_the_flag_takes(tmp_path: Path) -> None:
    model, mmproj = (path.read_bytes() for path in tiny_dummy())
    fetched(tmp_path, HUB_MODELS["gemma3-270m"], text=model)
    fetched(tmp_path, HUB_MODELS["gemma3-4b"], a_Q4_K_M=model, b=model, mmproj=mmproj)
    other = fetched(tmp_path, "some/robot-GGUF", c=model, mmproj=mmproj)
    fetched(tmp_path, "some/audio", mmproj=mmproj)
    found = rows()
    assert found["gemma3-270m"].picture_tokens is None
    assert [Path(path).name for path in found["gemma3-270m"].bytes] == ["text.gguf"]
    several = [f"hub:{HUB_MODELS['gemma3-4b']}:{file}.gguf" for file in ("a_Q4_K_M", "b")]
    new = [*several, "hub:some/robot-GGUF"]
    assert set(found) == {*HUB_MODELS, *new, str(tiny_dummy()[0])} - {"gemma3-4b"}
    for name in new:
        files = load_headers(EngineConfig(model=Path(name)))
        assert [str(files.model.path), str(files.mmproj and files.mmproj.path)] == list(found[name].bytes)
        assert found[name].picture_tokens == found[str(tiny_dummy()[0])].picture_tokens
    assert load_headers(EngineConfig(model=Path(new[-1]))).model.path == other / "c.gguf"


def test_a_damaged_file_is_a_row_that_says_so(tmp_path: Path) -> None:
    model, mmproj = tiny_dummy()
    fetched(tmp_path, HUB_MODELS["smolvlm2-500m"], a=model.read_bytes()[:-1000], mmproj=mmproj.read_bytes())
    fetched(tmp_path, HUB_MODELS["internvl3-2b"], a=model.read_bytes(), mmproj=b"no GGUF")
    fetched(tmp_path, HUB_MODELS["gemma3-4b"], a=mmproj.read_bytes(), mmproj=mmproj.read_bytes())
    found = {row["name"]: row for row in as_json()}
    cut, wrong, swapped = (found[name] for name in ("smolvlm2-500m", "internvl3-2b", "gemma3-4b"))
    assert (cut["state"], wrong["state"], found[str(model)]["state"]) == ("damaged", "damaged", "dummy")
    assert "cut short" in cut["error"]
    assert "not a GGUF file" in wrong["error"]
    assert "parameters" not in cut
    assert len(cut["bytes"]) == 2
    assert "a.gguf: llama.cpp: " in swapped["error"]
    assert "picture_tokens" not in swapped
    assert "smolvlm2-500m: file " in shown()


def test_without_llama_cpp_the_rest_is_listed_and_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = tiny_dummy()
    monkeypatch.delitem(sys.modules, "s2a_bench.inference.llama_log", raising=False)
    monkeypatch.delattr("s2a_bench.inference.llama_log", raising=False)
    monkeypatch.setitem(sys.modules, "llama_cpp", None)
    row = rows()[str(model)]
    assert row.parameters
    assert row.picture_tokens is None
    assert row.error
    assert row.error.endswith("pip install '.[llama]' in the clone of s2a-bench")
