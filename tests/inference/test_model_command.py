from pathlib import Path

import pytest
from typer.testing import CliRunner

from s2a_bench.cli.model import app


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


def test_the_default_folder_is_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    out = CliRunner().invoke(app, ["dummy", "--quant", "q4_0"]).stdout
    assert Path(out.splitlines()[0]).parent == tmp_path / "models" / "dummy-tiny"
