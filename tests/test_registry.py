from importlib.metadata import EntryPoint

import pytest

from s2a_bench.cli.adapter import with_flags
from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry[object]:
    offered = [
        EntryPoint("tail", "os.path:basename", "s2a_bench.things"),
        EntryPoint("join", "json:dumps", "s2a_bench.things"),
        EntryPoint("broken", "no_such_module:thing", "s2a_bench.things"),
    ]
    monkeypatch.setattr("s2a_bench.registry.entry_points", lambda *, group: offered if group else [])
    return Registry("things", "the_thing", {"join": "os.path:join"})


def test_built_ins_come_first_and_cannot_be_taken_over(registry: Registry[object]) -> None:
    assert list(registry) == ["join", "broken", "tail"]
    assert len(registry) == 3
    assert registry["join"].__name__ == "join"  # type: ignore[attr-defined]
    assert registry["tail"].__name__ == "basename"  # type: ignore[attr-defined]


def test_an_unknown_name_is_one_line_that_names_the_field_and_the_choice(registry: Registry[object]) -> None:
    assert "nothing" not in registry
    with pytest.raises(UsageError) as caught:
        registry["nothing"]
    assert str(caught.value).startswith("`the_thing`: 'nothing' is none of join, broken, tail")
    assert with_flags(str(caught.value)).startswith("--the-thing: 'nothing'")


def test_a_package_that_does_not_load_is_one_line_and_does_not_hide_the_others(registry: Registry[object]) -> None:
    with pytest.raises(UsageError, match="'broken' of the package no_such_module:thing does not load: ModuleNotFound"):
        registry["broken"]
    assert [name for name, _ in registry.loaded()] == ["join", "tail"]
