"""Experiments with modes: flags pick the class of the options, and options of another mode are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import pytest

from s2a_bench import library
from s2a_bench.cli.adapter import build, flags_named, flags_of
from s2a_bench.errors import UsageError
from s2a_bench.experiments import EXPERIMENTS, Experiment, RunMode
from s2a_bench.options import Options, group, option
from s2a_bench.progress import NullProgress, Progress


class Shared(Options):
    PANEL: ClassVar[str] = "Plans"

    seed: int = option(0, "seed")


class Computed(Shared):
    virtual: ClassVar[bool] = True

    lengths: int = option(6, "tokens a skill")
    plans: int = option(1, "plans a cell")


class Requests(Options):
    PANEL: ClassVar[str] = "Requests"

    url: str = option("", "a server")
    plans: str = option("", "no flag of this command")


class Live(Shared):
    lengths: int = option(4, "tokens a skill")
    requests: Requests = group(Requests, only=("url",))


class Looped(Live):
    step_s: float = option(0.1, "step")


class Predicted(Shared):
    predict: str = option(..., "a run folder")


def run(config: Options, output: Path, progress: Progress) -> Path:
    del progress
    return output / type(config).__name__


def run_live(config: Options, output: Path, progress: Progress) -> Path:
    return run(config, output, progress) / "live"


HERE = f"{__name__}:"
TOY = Experiment(
    name="toy",
    about="Toy.",
    config=f"{HERE}Computed",
    run=f"{HERE}run",
    view="",
    mode="computed",
    modes=(
        RunMode("live", f"{HERE}Live", f"{HERE}run_live", {"live": "a model answers"}),
        RunMode("loop", f"{HERE}Looped", f"{HERE}run", {"live": "", "closed_loop": "the world runs meanwhile"}),
        RunMode("predicted", f"{HERE}Predicted", f"{HERE}run", {"predict": ""}),
    ),
)


def made(**given: Any) -> Options:
    with flags_named(TOY):
        return build(TOY, given)


def test_flags_pick_the_class_and_its_function() -> None:
    assert made() == Computed()
    assert made(live=True, seed=3) == Live(seed=3)
    assert made(live=True, closed_loop=True, step_s=0.5, url="x") == Looped(step_s=0.5, requests={"url": "x"})
    assert made(predict="runs/1") == Predicted(predict="runs/1")
    assert made(predict="") == Computed()
    kinds = [type(config) for config in (made(), made(live=True), made(predict="a"))]
    assert [kind.virtual for kind in kinds] == [True, False, False]
    folders = [TOY.run_with(config, Path(), NullProgress()) for config in (made(), made(live=True), made(predict="a"))]
    assert folders == [Path("Computed"), Path("Live/live"), Path("Predicted")]


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"url": "x"}, "--url is an option of mode live: give --live"),
        ({"plans": 2, "live": True}, "--plans is an option of mode computed: leave out --live"),
        ({"step_s": 0.5}, "--step-s is an option of mode loop: give --live, give --closed-loop"),
        (
            {"plans": 2, "live": True, "closed_loop": True},
            "--plans is an option of mode computed: leave out --live, leave out --closed-loop",
        ),
        (
            {"url": "x", "closed_loop": True, "live": True, "predict": "a"},
            "--closed-loop and --live and --predict exclude each other",
        ),
        ({"url": "x", "predict": "a"}, "--url is an option of mode live: give --live, leave out --predict"),
        ({"closed_loop": True, "predict": "a"}, "--closed-loop and --predict exclude each other"),
    ],
)
def test_an_option_of_another_mode_is_refused_with_the_way_out(given: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError, match=f"^{line}$"):
        made(**given)


def test_help_groups_options_by_mode_and_names_the_defaults_of_each() -> None:
    panels: dict[str, list[str]] = {}
    for flag in flags_of(TOY):
        panels.setdefault(flag.panel, []).append(flag.name)
    assert panels == {
        "Modes": ["live", "closed-loop"],
        "Plans": ["seed"],
        "Plans (not with --predict)": ["lengths"],
        "Plans (not with --live or --closed-loop or --predict)": ["plans"],
        "Requests (with --live)": ["url"],
        "Plans (with --live --closed-loop)": ["step-s"],
        "Plans (with --predict)": ["predict"],
    }
    abouts = {flag.name: flag.about for flag in flags_of(TOY)}
    assert abouts["lengths"] == "tokens a skill [default: computed 6; live, loop 4]"
    assert not any(flag.needed for flag in flags_of(TOY))


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "EXPERIMENTS", {**EXPERIMENTS, "toy": TOY})
    monkeypatch.setattr(library, "Run", lambda path: path)


@pytest.mark.usefixtures("toy")
def test_the_library_picks_a_mode_by_its_name(tmp_path: Path) -> None:
    assert library.run("toy", output=tmp_path, plans=2) == tmp_path / "Computed"
    assert library.run("toy", output=tmp_path, mode="live", url="x") == tmp_path / "Live/live"
    with pytest.raises(UsageError, match=r"^`url` is of mode live: give `mode` 'live'$"):
        library.run("toy", output=tmp_path, url="x")
    with pytest.raises(UsageError, match=r"^`live` is of mode live: give `mode` 'live'$"):
        library.run("toy", output=tmp_path, live=True)
    with pytest.raises(UsageError, match="`mode`: 'lives' is not one of computed, live, loop, predicted"):
        library.run("toy", output=tmp_path, mode="lives")
