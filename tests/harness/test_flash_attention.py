"""Flash attention `auto`: measured once for a machine and model file, kept, and handed to every server."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from s2a_bench import extras
from s2a_bench.errors import EngineError, UsageError
from s2a_bench.harness import flash_attention
from s2a_bench.harness.flash_attention import decided, measured
from s2a_bench.harness.llama_flags import llama_flags
from s2a_bench.harness.llama_wheel import told
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import resolve


@pytest.fixture(scope="module")
def tiny() -> EngineConfig:
    model, mmproj = resolve(EngineConfig())
    return EngineConfig(model=model, mmproj=mmproj, threads=1)


class Machine:
    """A machine whose times are made up; counts how often it was asked to measure."""

    def __init__(self, on_ms: float, off_ms: float) -> None:
        self.times = {"on": on_ms, "off": off_ms}
        self.measured = 0
        self.busy = False
        self.fails: Exception | None = None

    def measure(self, _engine: EngineConfig, _log: Path | None) -> dict[str, dict[str, float]]:
        self.measured += 1
        if self.fails:
            raise self.fails
        return {way: {"prompt_ms": 1.0, "token_ms": 1.0, "answer_ms": ms} for way, ms in self.times.items()}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Machine]:
    made = Machine(100.0, 50.0)
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(flash_attention, "_measured_apart", made.measure)
    monkeypatch.setattr(flash_attention, "_busy", lambda: made.busy)
    return made


def decide(engine: EngineConfig) -> tuple[str, dict[str, Any]]:
    """Return what an engine gets, and what is told of it."""
    chosen, said = decided(engine, lambda _: None)
    return chosen.flash_attention, said.get("flash_attention", {})


@pytest.mark.parametrize(("on_ms", "off_ms", "winner"), [(100, 50, "off"), (100, 99, "on"), (50, 100, "on")])
def test_the_faster_way_wins_and_a_tie_goes_to_llama_cpps_choice(
    tiny: EngineConfig, machine: Machine, on_ms: float, off_ms: float, winner: str
) -> None:
    machine.times = {"on": on_ms, "off": off_ms}
    way, said = decide(tiny)
    assert way == said["chosen"] == winner
    assert said["asked"] == "auto"
    assert said["measured"]["on"]["answer_ms"] == on_ms


def test_it_is_measured_once_for_a_model_and_its_settings(tiny: EngineConfig, machine: Machine) -> None:
    assert [decide(tiny)[1]["cached"] for _ in range(3)] == [False, True, True]
    decide(tiny.but(context=512))
    assert machine.measured == 1
    decide(tiny.but(threads=2))
    decide(tiny.but(kv_type="f32"))
    assert machine.measured == 3


def test_what_was_seen_on_a_busy_machine_is_measured_again_on_a_quiet_one(tiny: EngineConfig, machine: Machine) -> None:
    machine.busy = True
    assert [decide(tiny)[1]["busy"] for _ in range(2)] == [True, True]
    assert machine.measured == 1
    machine.busy, machine.times = False, {"on": 1.0, "off": 2.0}
    assert [decide(tiny)[0] for _ in range(2)] == ["on", "on"]
    assert machine.measured == 2
    machine.busy = True
    decide(tiny)
    assert machine.measured == 2


@pytest.mark.parametrize("damage", ["", "{}", "[]", '{"chosen": "maybe", "busy": false}', '{"chosen": "on"}', "\0"])
def test_a_damaged_note_is_measured_again(tiny: EngineConfig, machine: Machine, damage: str, tmp_path: Path) -> None:
    decide(tiny)
    (note,) = (tmp_path / "cache" / "flash-attention").iterdir()
    note.write_text(damage)
    assert decide(tiny)[0] == "off"
    assert machine.measured == 2
    assert json.loads(note.read_text())["chosen"] == "off"


def test_a_cache_that_cannot_be_written_costs_time_only(
    tiny: EngineConfig, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", "/dev/null")
    assert [decide(tiny)[0] for _ in range(2)] == ["off", "off"]
    assert machine.measured == 2


def test_what_cannot_be_measured_stays_auto_and_says_why(
    tiny: EngineConfig, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.fails = EngineError("no memory")
    assert decide(tiny) == ("auto", {"asked": "auto", "chosen": "auto", "why": "no memory"})
    monkeypatch.setattr(extras, "installed", lambda _module: False)
    assert "llama-cpp-python is not installed" in decide(tiny)[1]["why"]


@pytest.mark.parametrize("kv_type", ["q8_0", "q4_0"])
def test_a_quantised_cache_has_no_choice(tiny: EngineConfig, machine: Machine, kv_type: str) -> None:
    assert decide(tiny.but(kv_type=kv_type))[0] == "on"
    assert not machine.measured


def test_who_says_on_or_off_is_obeyed(tiny: EngineConfig, machine: Machine) -> None:
    for way in ("on", "off"):
        assert decide(tiny.but(flash_attention=way)) == (way, {})
    assert decide(EngineConfig(name="echo")) == ("auto", {})
    assert decide(EngineConfig()) == ("auto", {})  # no files: nobody here computes
    assert not machine.measured


@pytest.mark.usefixtures("machine")
def test_every_kind_of_server_is_told_the_winner(tiny: EngineConfig) -> None:
    engine, _ = decided(tiny, lambda _: None)
    assert llama_flags(engine)[-2:] == ["--flash-attn", "off"]
    assert told(engine, 0, ignore_end=True)["flash_attention"] == "off"


def test_both_ways_are_measured_with_the_model(tiny: EngineConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flash_attention, "ROUNDS", 1)
    best = measured(tiny.but(context=512))  # a picture does not fit into that: it is measured with more
    assert set(best) == {"on", "off"}
    for times in best.values():
        assert times["answer_ms"] == pytest.approx(times["prompt_ms"] + flash_attention.TOKENS * times["token_ms"])
        assert min(times.values()) > 0


def test_the_measuring_process_tells_what_is_wrong(tiny: EngineConfig, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`kv_type` q4_0 needs flash attention"):
        flash_attention._measured_apart(tiny.but(kv_type="q4_0"), tmp_path / "log")  # it turns it off in turn
