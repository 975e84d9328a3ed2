from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.cli.adapter import with_flags
from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry, missing_entry_points


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry[object]:
    offered = [
        EntryPoint("tail", "os.path:basename", "s2a_bench.things"),
        EntryPoint("join", "json:dumps", "s2a_bench.things"),
        EntryPoint("broken", "no_such_module:thing", "s2a_bench.things"),
    ]
    monkeypatch.setattr("s2a_bench.registry.installed_points", lambda: EntryPoints(offered))
    return Registry("things", "the_thing", {"join": "os.path:join"})


def test_built_ins_come_first_and_cannot_be_taken_over(registry: Registry[object]) -> None:
    assert list(registry) == ["join", "broken", "tail"]
    assert len(registry) == 3
    assert registry["join"].__name__ == "join"  # type: ignore[attr-defined]
    assert registry["tail"].__name__ == "basename"  # type: ignore[attr-defined]


@pytest.mark.parametrize("turn", [1, -1])
def test_of_two_packages_with_one_name_ours_counts_else_the_first_by_module(
    turn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    modules = {"x": ("a:join", "s2a_bench.text:like"), "y": ("ntpath:join", "posixpath:join")}
    offered = [EntryPoint(name, each, "s2a_bench.things") for name, found in modules.items() for each in found]
    monkeypatch.setattr("s2a_bench.registry.installed_points", lambda: EntryPoints(offered[::turn]))
    things = Registry[Any]("things", "thing", {})
    assert [things[name].__module__ for name in things] == ["s2a_bench.text", "ntpath"]


def test_an_unknown_name_is_one_line_that_names_the_field_and_the_choice(registry: Registry[object]) -> None:
    assert "nothing" not in registry
    with pytest.raises(UsageError) as caught:
        registry["nothing"]
    assert str(caught.value).startswith("`the_thing`: 'nothing' is not one of join, broken, tail")
    assert with_flags(str(caught.value)).startswith("--the-thing: 'nothing'")


def test_a_package_that_does_not_load_is_one_line_and_does_not_hide_the_others(registry: Registry[object]) -> None:
    with pytest.raises(UsageError, match="'broken' of the package no_such_module:thing does not load: ModuleNotFound"):
        registry["broken"]
    assert [name for name, _ in registry.loaded()] == ["join", "tail"]


def test_a_checkout_that_is_older_than_its_plug_ins_names_them(tmp_path: Path) -> None:
    assert missing_entry_points() == []  # this one: if not, run `make setup`
    assert missing_entry_points(tmp_path) == []  # no checkout, but an installed package
    declared = '[project]\nname = "s2a-bench"\n[project.entry-points."s2a_bench.simulators"]\nmoon = "a:b"\n'
    moved = '[project.entry-points."s2a_bench.middlewares"]\nrclpy = "a:b"\nzenoh = "s2a_bench.plugins.zenoh:ZENOH"\n'
    (tmp_path / "pyproject.toml").write_text(declared + moved)
    assert missing_entry_points(tmp_path) == ["moon", "rclpy"]
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "of-somebody"')  # who installed us beside it
    assert missing_entry_points(tmp_path) == []
