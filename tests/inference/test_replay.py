"""The replay engine on a virtual clock: its times are the profile's, to the nanosecond where they are recorded."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.boards.profile import to_toml
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import UsageError
from s2a_bench.inference import Engine, EngineConfig, check_engine, open_engine
from s2a_bench.inference.replay import GAPS, ReplayEngine
from s2a_bench.plan import Parser, SkillParsed, load_skills, paper_format
from s2a_bench.testing.engine import EngineSuite, ask
from s2a_bench.types import Request

RECORDED_NS = [[111, 222], [1_000_001, 2_000_003, 3_000_007], [5_000_011, 7_000_013]]
PLAYED_NS = [gap for row in RECORDED_NS[1:] for gap in row]


@pytest.fixture
def recorded(tmp_path: Path) -> str:
    """Write a profile with a recording."""
    tables = {
        "title": "A board",
        "origin": "measured",
        "tokens_per_s": len(PLAYED_NS) / (sum(PLAYED_NS) / 1e9),
        "prompt_s": 0.25,
        "prompt_cv": 0.2,
        "gaps": {"family": "lognormal", "cv": 0.4},
        "model": {"dummy": True},
        "trace": {"warmups": 1, "gaps_ns": RECORDED_NS},
    }
    path = tmp_path / "recorded.toml"
    path.write_text(to_toml(tables))
    return str(path)


def replay(profile: str, gaps: str = "") -> tuple[ReplayEngine, VirtualClock]:
    clock = VirtualClock(10**12)
    return ReplayEngine(EngineConfig(name="replay", profile=profile, gaps=gaps), clock), clock


def times_ns(engine: ReplayEngine, clock: VirtualClock, tokens: int, **rest: Any) -> list[int]:
    """Ask once and return when each token came, from the request."""
    started = clock.now_ns()
    return [clock.now_ns() - started for _ in engine.generate(Request("r", "go", max_tokens=tokens, **rest))]


class TestReplay(EngineSuite):
    @pytest.fixture(params=list(GAPS))
    def engine(self, recorded: str, request: pytest.FixtureRequest) -> Engine:
        return replay(recorded, request.param)[0]

    @pytest.fixture
    def fresh_engine(self, engine: Engine) -> Engine:
        return engine


def test_a_recording_is_played_exactly_request_after_request_and_again_from_its_start(recorded: str) -> None:
    engine, clock = replay(recorded, "trace")
    gaps = [np.diff(times_ns(engine, clock, tokens)).tolist() for tokens in (4, 3, 2, 7)]
    assert gaps == [PLAYED_NS[:3], PLAYED_NS[3:], PLAYED_NS[:1], [*PLAYED_NS[1:], *PLAYED_NS[:2]]]


def test_an_answer_closed_early_leaves_the_rest_of_the_recording_to_the_next(recorded: str) -> None:
    engine, clock = replay(recorded, "trace")
    tokens = engine.generate(Request("early", "go", max_tokens=6))
    for _ in range(3):
        next(tokens)
    tokens.close()  # type: ignore[attr-defined]
    assert np.diff(times_ns(engine, clock, 3)).tolist() == PLAYED_NS[2:4]


def test_constant_gaps_are_exactly_the_rate_from_the_first_token_on() -> None:
    engine, clock = replay("jetson-agx-orin", "constant")
    came = times_ns(engine, clock, 49)
    gap_s = 1 / 4.8
    np.testing.assert_allclose(np.array(came) / 1e9, 0.5 + gap_s * np.arange(1, 50), rtol=0, atol=50e-9)


@pytest.mark.parametrize(("name", "rate"), [("rtx-4080", 34.2), ("jetson-agx-orin", 4.8), ("jetson-orin-nano", 0.58)])
def test_a_parametric_run_has_the_rate_the_first_token_and_the_spread_of_its_profile(name: str, rate: float) -> None:
    engine, clock = replay(name, "parametric")
    came = np.array([times_ns(engine, clock, 101) for _ in range(400)]) / 1e9
    gaps = np.diff(came, axis=1)
    assert 1 / gaps.mean() == pytest.approx(rate, rel=0.01)
    assert gaps.std() / gaps.mean() == pytest.approx(0.2, rel=0.05)
    prompt = came[:, 0] - 1 / rate
    expected = {"rtx-4080": 0.05, "jetson-agx-orin": 0.5, "jetson-orin-nano": 3.0}[name]
    assert prompt.mean() == pytest.approx(expected, rel=0.03)
    assert prompt.std() / prompt.mean() == pytest.approx(0.15, rel=0.15)


def test_the_first_token_waits_for_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, _ = replay("rtx-4080")
    made = []
    monkeypatch.setattr("s2a_bench.inference.replay._plan", lambda _seed: (made.append(n) or str(n) for n in count()))
    assert next(iter(engine.generate(Request("r", "go", max_tokens=2**40)))).text == "0"
    assert made == [0]


def test_times_differ_from_request_to_request_and_are_the_same_in_the_next_run() -> None:
    def run(seed: int) -> list[list[int]]:
        engine, clock = replay("rtx-4080")
        return [times_ns(engine, clock, 5, seed=seed) for _ in range(3)]

    first = run(7)
    assert first == run(7)
    assert first != run(8)
    assert len({tuple(times) for times in first}) == 3


class LateClock(VirtualClock):
    """Wakes up late, as every real clock."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        super().sleep_until_ns(deadline_ns)
        super().sleep_until_ns(self.now_ns() + 3_000_000)


def test_late_wake_ups_do_not_add_up() -> None:
    clock = LateClock()
    engine = ReplayEngine(EngineConfig(name="replay", profile="rtx-4080", gaps="constant"), clock)
    came = times_ns(engine, clock, 200)
    assert came[-1] == pytest.approx((0.05 + 200 / 34.2) * 1e9 + 3e6, abs=1000)


def test_a_reader_that_was_away_gets_what_has_come_meanwhile_at_once() -> None:
    engine, clock = replay("rtx-4080", "constant")
    tokens = engine.generate(Request("r", "go", max_tokens=40))
    next(tokens)
    clock.sleep_until_ns(clock.now_ns() + 10**9)
    back = clock.now_ns()
    for _ in range(34):  # 34.2 tokens a second
        next(tokens)
    assert clock.now_ns() == back
    next(tokens)
    assert clock.now_ns() > back


def test_the_text_is_numbered_skill_calls_of_six_tokens() -> None:
    engine, _ = replay("rtx-4080")
    tokens = ask(engine, max_tokens=24, seed=3)
    lines = "".join(token.text for token in tokens).splitlines()
    assert [re.sub(r"[a-z_]+\([a-z]+\)", "call", line) for line in lines] == [f"{n}. call" for n in (1, 2, 3, 4)]
    assert [token.index for token in tokens if token.text.endswith("\n")] == [5, 11, 17, 23]
    parser = Parser(paper_format(load_skills("household")))
    parsed = [event for token in tokens for event in parser.feed(token.text)]
    assert [(event.index, event.piece) for event in parsed if isinstance(event, SkillParsed)] == [
        (0, 5),
        (1, 11),
        (2, 17),
        (3, 23),
    ]
    assert ask(engine, max_tokens=24, seed=4) != tokens


def test_it_says_that_it_is_emulated_and_of_what(recorded: str) -> None:
    facts = open_engine(EngineConfig(name="replay", profile=recorded)).describe()
    assert facts["emulated"] is True
    assert (facts["profile"], facts["origin"], facts["gaps"], facts["dummy"]) == ("recorded", "measured", "trace", True)
    facts = open_engine(EngineConfig(name="replay", profile="rtx-4080")).describe()
    assert (facts["profile"], facts["origin"], facts["gaps"], facts["dummy"]) == (
        "rtx-4080",
        "paper",
        "parametric",
        False,
    )
    assert facts["assumed"] == "prompt_s, prompt_cv, rate_cv, gaps"


def test_facts_tell_prompt_and_decoding_time() -> None:
    engine, clock = replay("jetson-agx-orin", "constant")
    times_ns(engine, clock, 11)
    assert engine.facts == {
        "prompt_ms": 500.0,
        "predicted_n": 11.0,
        "predicted_ms": pytest.approx(11 / 4.8 * 1e3, abs=0.001),
    }


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EngineConfig(name="replay"), "`engine` replay needs `profile` NAME"),
        (EngineConfig(name="replay", profile="tx1"), "`profile`: 'tx1' is not one of"),
        (EngineConfig(name="replay", profile="rtx-4080", gaps="trace"), "profile rtx-4080 holds no recording"),
        (EngineConfig(name="replay", profile="rtx-4080", gaps="wild"), "'wild' is not one of constant, parametric"),
        (EngineConfig(name="llama", gaps="trace"), "`gaps` needs `engine` replay"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(config: EngineConfig, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_engine(config)
