"""`s2a-bench profile`, and the replay of a profile through `latency` and `serve`, as a user meets them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from s2a_bench.boards.profile import read_profile, to_toml
from tests.cli.program import called, printed, refused

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/s2a-bench-profile-1.json").read_text())
FAST = {
    "title": "A fast board",
    "origin": "measured",
    "tokens_per_s": 2000.0,
    "prompt_s": 0.01,
    "gaps": {"family": "lognormal", "cv": 0.1},
    "model": {"dummy": True},
}


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a profile of its own, and work in it."""
    (tmp_path / "profiles").mkdir()
    (tmp_path / "profiles" / "fast.toml").write_text(to_toml(FAST))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_list_names_the_profiles_of_this_folder_and_those_that_ship() -> None:
    done = called("profile", "list")
    lines = {line.split()[0]: line for line in done.stdout.splitlines() if "assumed" in line or "measured" in line}
    assert list(lines) == ["fast", "jetson-agx-orin", "jetson-orin-nano", "rtx-4080"]
    assert "measured, dummy" in lines["fast"]
    assert "0.0105" in lines["fast"]  # .01 s and a gap of .5 ms
    assert "0.708 (assumed)" in lines["jetson-agx-orin"]
    found = printed(called("profile", "list", "--json"), SCHEMA)
    assert found["command"] == "profile list"
    assert [profile["name"] for profile in found["profiles"]] == list(lines)
    assert [profile["dummy"] for profile in found["profiles"]] == [True, False, False, False]


def test_a_wrong_file_is_named_and_the_others_are_listed(home: Path) -> None:
    (home / "profiles" / "bad.toml").write_text(to_toml(FAST | {"tokens_per_s": -1}))
    done = called("profile", "list")
    wrong = "profile profiles/bad.toml: tokens_per_s: -1 should be greater than 0"
    assert done.stderr == f"left out: {wrong}\n"
    assert "fast" in done.stdout
    assert refused("profile", "show", "bad") == f"error: {wrong}"


def test_show_says_where_numbers_are_from() -> None:
    text = called("profile", "show", "rtx-4080").stdout
    assert "RTX 4080, 34.2 tokens/s, first token after 0.0792 s (paper)" in text
    assert "assumed, not from paper data: prompt_s, prompt_cv, rate_cv, gaps" in text
    assert "  gpu: GeForce RTX 4080" in text
    (shown,) = printed(called("profile", "show", "profiles/fast.toml", "--json"), SCHEMA)["profiles"]
    assert (shown["tokens_per_s"], shown["gaps"]) == (2000, {"family": "lognormal", "cv": 0.1})
    assert shown["file"] == "profiles/fast.toml"


def test_capture_measures_this_machine_which_match_then_finds(home: Path) -> None:
    none = called("profile", "match", code=1)
    assert "no profile is of this board" in none.stdout
    flags = ["--threads", "1", "--requests", "5", "--warmup", "1", "--tokens", "12", "--size", "64x48"]
    done = called("profile", "capture", "here", *flags, "--title", "My board", "--json")
    (made,) = printed(done, SCHEMA)["profiles"]
    assert made["file"] == "profiles/here.toml"
    assert (made["recorded"], made["dummy"], made["title"]) == (55, True, "My board")
    profile = read_profile(home / "profiles" / "here.toml")
    assert profile.facts["model"]["threads"] == 1
    assert len(profile.facts["model"]["model_sha256"]) == 64
    found = printed(called("profile", "match", "--json"), SCHEMA)
    assert [profile["name"] for profile in found["profiles"]] == ["here"]
    assert found["profiles"][0]["differences"] == []
    error = refused("profile", "capture", "here", *flags)
    assert "profiles/here.toml exists already; give another NAME or --output, or --force" in error


def test_where_nothing_can_be_written_nothing_is_measured(home: Path) -> None:
    (home / "file").write_text("")
    error = refused("profile", "capture", "here", "--output", "file/profiles", code=1)
    assert error == "error: --output: cannot write file/profiles/here.toml: Not a directory"
