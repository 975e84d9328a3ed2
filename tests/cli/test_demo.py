"""`s2a-bench demo`: two short runs, one page, the sentences to read off."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import pytest

from s2a_bench import library
from s2a_bench.cli import demo
from s2a_bench.report.page import files
from s2a_bench.store.run import read_run
from tests.cli.program import called, program, refused

SMALL = {
    "latency": {"transports": ("loopback",), "engine": "echo", "size": "64x48", "requests": 6},
    "timeline": {"tokens_per_skill": (6,), "profiles": ("jetson-agx-orin",)},
}


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Make both runs small; return the URLs that a browser would open."""
    urls: list[str] = []
    monkeypatch.setattr(demo, "RUNS", SMALL)
    monkeypatch.setattr(webbrowser, "open", urls.append)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    return urls


def kept(output: Path) -> dict[str, str]:
    """Return command -> state of the run folders."""
    runs = (read_run(folder) for folder in sorted(output.iterdir()) if folder.is_dir())
    return {str(run.manifest["command"]): str(run.manifest["state"]) for run in runs}


def test_two_runs_become_one_page_with_a_figure_of_each(tmp_path: Path, opened: list[str]) -> None:
    done = called("demo", "--output", tmp_path)
    page = (tmp_path / "demo.html").read_text()
    assert "Stages, medians: end to end" in page
    assert "Execution timelines: N = 8 skills" in page
    assert "Distribution: end to end" not in page
    assert kept(tmp_path) == {"latency": "finished", "timeline": "finished"}
    assert "  naive stalls in the only setting, on Jetson AGX Orin with L = 6: 1.75 s a plan;" in done.stdout
    assert done.stdout.splitlines()[-4:] == [
        f"Page: {tmp_path / 'demo.html'}",
        "Next:",
        *(f"  {line}" for line in demo.NEXT),
    ]
    assert opened == []


@pytest.mark.parametrize(("flags", "urls"), [((), 1), (("--no-open",), 0)])
def test_a_browser_opens_the_page_where_there_is_a_display(
    flags: tuple[str, ...], urls: int, tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    called("demo", "--output", tmp_path, *flags)
    assert opened == [(tmp_path / "demo.html").as_uri()] * urls


def test_ctrl_c_keeps_what_was_measured_and_says_how_to_see_it(
    tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = library.run

    def interrupted(name: str, **options: object) -> library.Run:
        if name == "timeline":
            raise KeyboardInterrupt
        return runs(name, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(library, "run", interrupted)
    done = called("demo", "--output", tmp_path, code=130)
    (folder,) = tmp_path.iterdir()
    assert f"what was measured so far: s2a-bench report {folder}\n" in done.stderr
    assert kept(tmp_path) == {"latency": "finished"}
    assert opened == []


def test_ctrl_c_while_the_page_is_drawn_names_both_runs(
    tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "write_report", interrupted)
    done = called("demo", "--output", tmp_path, code=130)
    first, second = sorted(tmp_path.iterdir())
    assert f"what was measured so far: s2a-bench report {first} {second}\n" in done.stderr
    assert opened == []


def test_a_page_that_no_report_wrote_is_refused_before_anything_is_measured(tmp_path: Path, opened: list[str]) -> None:
    (tmp_path / "demo.html").write_text("mine")
    assert "s2a-bench report did not write it" in refused("demo", "--output", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["demo.html"]
    assert opened == []


@pytest.mark.slow
def test_the_whole_demo_compares_http_with_ros_and_names_intervals(tmp_path: Path) -> None:
    lines = program("demo", "--no-open", cwd=tmp_path).stdout.splitlines()
    (ratio,) = (line for line in lines if "http/as-deployed takes " in line)
    assert "times as long as ros/topic" in ratio
    assert "95 %" in ratio
    assert any("http/binary" in line for line in lines)
    assert any(line.startswith("  naive stalls in 2 of 3 settings, most on Jetson Orin Nano") for line in lines)
    assert (tmp_path / "results" / "demo.html").is_file()
