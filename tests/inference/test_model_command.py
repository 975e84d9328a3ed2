from pathlib import Path

import pytest
from typer.testing import CliRunner

from s2a_bench.cli.model import app
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import load_headers


def test_it_prints_the_two_paths_and_writes_once_unless_forced(tmp_path: Path) -> None:
    run = CliRunner()
    first = run.invoke(app, ["dummy", "--output", str(tmp_path)])
    assert first.exit_code == 0, first.output
    model, mmproj = map(Path, first.stdout.splitlines())
    assert {model, mmproj} == set(tmp_path.iterdir())
    assert model.name.endswith("-f16.gguf")
    assert mmproj.name.startswith("mmproj-")
    model.write_bytes(b"mine")
    assert run.invoke(app, ["dummy", "--output", str(tmp_path)]).stdout == first.stdout
    assert model.read_bytes() == b"mine"
    run.invoke(app, ["dummy", "--output", str(tmp_path), "--force"])
    assert model.stat().st_size > 1e6


def test_a_dummy_of_another_model_has_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with two mmproj files would be one of which none is found."""
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    paths = CliRunner().invoke(app, ["dummy", "--like", "gemma3-4b"]).stdout.splitlines()
    folder = tmp_path / "models" / "dummy-gemma3-4b-tiny"
    assert {*map(Path, paths)} == set(folder.iterdir())
    assert load_headers(EngineConfig(model=Path(paths[0]))).mmproj.path == Path(paths[1])
