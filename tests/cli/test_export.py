"""`s2a-bench report --export` as a user runs it, and what reads its folder."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tests.cli.program import called, refused
from tests.made_runs import MakeRun


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_run_is_exported_and_then_compared_and_reported(make_run: MakeRun) -> None:
    run = make_run(manifest={"environment": {"host": socket.gethostname(), "home": str(Path.home())}})
    done = called("report", run.path, "--export", "shared")
    (folder,) = Path("shared").iterdir()
    assert (done.stdout, done.stderr) == (f"run to share: {folder}\n", "")
    assert {path.name for path in Path().iterdir()} == {run.path.name, "shared"}
    manifest = (folder / "manifest.json").read_text()
    assert {run.path.name, str(Path.cwd())}.isdisjoint(manifest.split('"'))
    compared = called("compare", run.path, folder)
    assert "0.0 %" in compared.stdout
    assert "[differs]" not in compared.stderr
    assert called("report", folder, "--markdown", "shared.md").stdout == "Markdown: shared.md\n"


def test_a_folder_that_no_export_wrote_is_refused_before_anything_is_written(make_run: MakeRun) -> None:
    run = make_run(n=2)
    message = refused("report", run.path, "--export", run.path, "--markdown", "all.md")
    assert message.startswith(f"error: --export: {run.path} has manifest.json, which no export wrote")
    assert not Path("all.md").exists()
