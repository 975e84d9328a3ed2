"""The library as a notebook uses it: experiments as functions, runs that show themselves, a process left alone."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import s2a_bench as s2a
from s2a_bench.errors import UnlikeRuns, UsageError
from s2a_bench.machine.tuning import SINGLE_THREADED

QUIET = """
import os, sys
import cv2
before = dict(os.environ), cv2.getNumThreads()
import s2a_bench as s2a
for tune in (True, False):
    run = s2a.latency(transports=["loopback"], engine="echo", size="64x48", requests=6, output=sys.argv[1], tune=tune)
    assert (dict(os.environ), cv2.getNumThreads()) == before, "the caller's process was changed"
    assert run.manifest["tuning"]["process"] is tune
"""


def test_the_names_are_those_that_it_says() -> None:
    assert set(s2a.__all__) <= set(dir(s2a))
    assert all(getattr(s2a, name) is not None for name in s2a.__all__)
    with pytest.raises(AttributeError, match="no attribute 'teleport'"):
        _ = s2a.teleport


def test_its_page_names_all_of_them() -> None:
    page = (Path(__file__).parent.parent / "docs" / "library.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (.*?) \|", page, re.MULTILINE)
    assert set(s2a.__all__) <= set(re.findall(r"`(\w+)", " ".join(cells)))


def test_a_run_shows_its_rows_tables_and_figures(tmp_path: Path) -> None:
    run = s2a.boundary(points=5, most_tokens=3, output=tmp_path)
    assert run.path.parent == tmp_path
    assert run.manifest["configuration"]["points"] == 5
    table = run.table("boundary")
    assert {"duration", "stall_free", "p_stall"} <= set(table.columns)
    assert "boards" in run.tables
    assert run.table("boards").columns[0] == "board"
    assert list(run.figures()) == ["boundary"]
    figure = run.plot("boundary")
    png, size = figure._repr_png_()
    assert (png.startswith(b"\x89PNG"), size["width"]) == (True, 525)
    assert "<figcaption><b>Stall-free region of naive execution.</b> N = " in figure._repr_html_()
    with pytest.raises(UsageError, match="a boundary run has no figure 'stages', only boundary"):
        run.plot("stages")
    assert run.json()["command"] == "boundary"
    assert "Boards: is naive stall-free?" in run._repr_html_()
    assert (run.save() / "figures" / "boundary.png").exists()
    assert s2a.load(run.path).table("boundary").equals(table)
    with pytest.raises(UsageError, match="no table 'stages', only boundary, boards"):
        run.table("stages")


def test_samples_leave_warm_ups_out_and_runs_are_compared(tmp_path: Path) -> None:
    few = {"transports": ["loopback"], "engine": "echo", "size": "64x48", "requests": 12, "output": tmp_path}
    one, other = s2a.latency(**few, warmup=2), s2a.latency(**few, warmup=2)
    assert one.all_samples["warmup"].tolist() == [True] * 2 + [False] * 12
    assert one.samples["request_id"].tolist() == one.all_samples["request_id"].tolist()[2:]
    assert s2a.load(one.path).samples.equals(one.samples)
    assert set(one.table("stages")["cell"]) == {"loopback"}
    compared = s2a.compare(one, other.path)
    assert "| cell | n | A | B |" in str(compared)
    assert set(compared.table()["cell"]) == {"loopback"}
    assert "loopback" in compared._repr_html_()


def test_a_field_is_named_in_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^`points`: 1 should be greater than or equal to 2$"):
        s2a.boundary(points=1, output=tmp_path)
    with pytest.raises(UsageError, match=r"^`runs` is not one of the options transports"):
        s2a.latency(runs=50)
    with pytest.raises(UsageError, match=r"^`speed` is not one of the options profiles"):
        s2a.boundary(speed=1, output=tmp_path)


def test_a_run_leaves_the_callers_process_as_it_was_and_is_like_one_of_the_command(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in SINGLE_THREADED}

    def run(*command: str | Path) -> None:
        subprocess.run([sys.executable, *command], check=True, capture_output=True, env=environment)

    options = ("--transport", "loopback", "--engine", "echo", "--size", "64x48", "--requests", "6", "--data-only")
    run("-m", "s2a_bench", "latency", *options, "--output", tmp_path)
    run("-W", "error", "-c", QUIET, tmp_path)
    command, library, untuned = sorted(tmp_path.iterdir())
    assert set(s2a.compare(command, library).table()["cell"]) == {"loopback"}
    with pytest.raises(UnlikeRuns, match=r"tuning process: tuned against not tuned \(the library's tune=False\)"):
        s2a.compare(command, untuned)


NOTEBOOK = """
import s2a_bench as s2a
run = s2a.boundary(points=5, most_tokens=3)
run.plot("boundary")
---
from matplotlib.figure import Figure
figure = run.plot("boundary")
assert isinstance(figure, Figure)
display(figure)
---
run
"""


@pytest.mark.slow
def test_a_notebook_shows_figures_without_magics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    nbformat = pytest.importorskip("nbformat").v4
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path))
    notebook = nbformat.new_notebook(cells=[nbformat.new_code_cell(cell) for cell in NOTEBOOK.split("---")])
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}).execute()
    *drawn, shown = (cell.outputs for cell in notebook.cells)
    for (output,) in drawn:
        assert base64.b64decode(output.data["image/png"]).startswith(b"\x89PNG")
        assert output.metadata["image/png"]["width"] == 525
        assert "<figcaption><b>Stall-free region of naive execution.</b> N = " in output.data["text/html"]
    assert "Boards: is naive stall-free?" in shown[0].data["text/html"]
