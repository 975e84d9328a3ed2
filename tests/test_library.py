"""The library as a notebook uses it: experiments as functions, runs that show themselves, a process left alone."""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


EXAMPLE = Path(__file__).parent.parent / "examples" / "first_contact.ipynb"


@pytest.fixture
def execute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], list[Any]]:
    """Return what executes a notebook in a temporary folder, and returns its cells of code."""
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path))

    def executed(notebook: Any) -> list[Any]:
        nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}).execute()
        return [cell for cell in notebook.cells if cell.cell_type == "code"]

    return executed


@pytest.mark.slow
def test_a_notebook_shows_figures_without_magics(execute: Callable[[Any], list[Any]]) -> None:
    nbformat = pytest.importorskip("nbformat").v4
    notebook = nbformat.new_notebook(cells=[nbformat.new_code_cell(cell) for cell in NOTEBOOK.split("---")])
    *drawn, shown = (cell.outputs for cell in execute(notebook))
    for (output,) in drawn:
        assert base64.b64decode(output.data["image/png"]).startswith(b"\x89PNG")
        assert output.metadata["image/png"]["width"] == 525
        assert "<figcaption><b>Stall-free region of naive execution.</b> N = " in output.data["text/html"]
    assert "Boards: is naive stall-free?" in shown[0].data["text/html"]


def test_the_example_is_kept_without_outputs_and_its_links_lead_somewhere() -> None:
    cells = json.loads(EXAMPLE.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all((cell["outputs"], cell["execution_count"]) == ([], None) for cell in code)
    links = re.findall(r"\]\(([^)]+)\)", "".join(line for cell in cells for line in cell["source"]))
    assert len(links) > 3
    assert [link for link in links if not (EXAMPLE.parent / link).exists()] == []


@pytest.mark.slow
def test_the_example_comes_to_tables_figures_and_a_ratio(execute: Callable[[Any], list[Any]]) -> None:
    notebook = pytest.importorskip("nbformat").read(EXAMPLE, 4)
    shown = {cell.id: cell.outputs[-1].data for cell in execute(notebook) if cell.outputs}
    figures = {name: data for name, data in shown.items() if "image/png" in data}
    assert list(figures) == ["figure", "plans"]
    assert all(base64.b64decode(data["image/png"]).startswith(b"\x89PNG") for data in figures.values())
    assert "Stages in ms" in shown["run"]["text/html"]
    for stage in ("base64_encode", "json_parse", "cdr_pack", "return"):
        assert stage in shown["table"]["text/html"]
    (ratio,) = re.findall(r"ros/topic +([\d.]+) +([\d.]+) +([\d.]+)", shown["ratios"]["text/plain"])
    value, low, high = map(float, ratio)
    assert low < value < high
    assert "network_ns" in shown["load"]["text/html"]
