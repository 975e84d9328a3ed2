"""From timed answers to a profile that another machine replays: rate, distribution, exact recording."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ks_2samp

from s2a_bench.boards.gaps import Gaps, Lognormal, Quantiles
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import EngineError, StoreError, UsageError
from s2a_bench.experiments.profile_capture import CaptureConfig, run
from s2a_bench.experiments.profile_capture.run import (
    TimedAnswer,
    answers,
    document,
    rate_cv,
    write_profile,
)
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.echo import EchoEngine
from s2a_bench.inference.replay import ReplayEngine
from s2a_bench.types import Request

MODEL = {"engine": "llama", "dummy": True, "name": "tiny", "secret": "no fact of the model"}
PAUSES = Quantiles(0.02, (0, 0.5, 0.96, 0.97, 1), (1, 1.02, 1.3, 6, 20))


def recording(gaps: Gaps, seed: int, requests: int, tokens: int = 64) -> list[TimedAnswer]:
    """Make answers up: TTFT .5 s on average, gaps of a family."""
    rng = np.random.default_rng(seed)
    rows = (gaps.sample(rng, tokens - 1, requests).T * 1e9).round().astype(int).tolist()
    return [TimedAnswer(int(rng.normal(5e8, 2e7)), row) for row in rows]


def saved(path: Path, recorded: list[TimedAnswer], **settings: Any) -> Path:
    config = CaptureConfig(name="board", **{"requests": len(recorded) - 2, "warmup": 2, **settings})
    write_profile(document(config, recorded, MODEL, ["load: high; wait"]), path, force=False)
    return path


@pytest.mark.parametrize("truth", [Lognormal(0.2, 0.25), PAUSES], ids=["lognormal", "rare pauses"])
def test_a_parametric_replay_has_the_rate_and_is_not_rejected_by_a_recording_it_has_not_seen(
    tmp_path: Path, truth: Gaps
) -> None:
    recorded = recording(truth, 0, 62)
    path, clock = saved(tmp_path / "board.toml", recorded), VirtualClock()
    engine = ReplayEngine(EngineConfig(name="replay", profile=str(path), gaps="parametric"), clock)
    requests = [Request(str(number), "go", max_tokens=64) for number in range(2000)]
    played = np.ravel([np.diff([clock.now_ns() for _ in engine.generate(request)]) for request in requests])
    rate = 1e9 / np.mean([answer.gaps_ns for answer in recorded[2:]])
    assert 1e9 / played.mean() == pytest.approx(rate, rel=0.01)
    unseen = np.ravel([answer.gaps_ns for answer in recording(truth, 50, 16)])
    assert ks_2samp(unseen, played[: unseen.size]).pvalue > 0.01
    assert ks_2samp(unseen, played[: unseen.size] * 1.1).pvalue < 1e-6  # a rate 10 % off would show


def test_the_profile_says_what_was_measured(tmp_path: Path) -> None:
    recorded = recording(Lognormal(0.1, 0.2), 3, 22)
    config = CaptureConfig(name="board", requests=20, warmup=2, size=(320, 240))
    profile = write_profile(document(config, recorded, MODEL, ["load: high"]), tmp_path / "board.toml", force=False)
    gaps = [gap / 1e9 for answer in recorded[2:] for gap in answer.gaps_ns]
    ttft = np.array([answer.ttft_ns / 1e9 for answer in recorded[2:]])
    assert profile.origin == "measured"
    assert profile.trace_s == tuple(gaps)
    assert profile.tokens_per_s == pytest.approx(1 / np.mean(gaps))
    assert profile.prompt_s + 1 / profile.tokens_per_s == pytest.approx(ttft.mean())
    assert profile.prompt_cv * profile.prompt_s == pytest.approx(ttft.std(ddof=1))
    assert profile.assumed == ()
    assert profile.facts["model"] == {"name": "tiny", "dummy": True}
    assert profile.facts["capture"]["warnings"] == ["load: high"]
    assert profile.facts["capture"]["size"] == "320x240"
    assert profile.facts["fit"]["family"] == "lognormal"
    assert profile.facts["board"]["cores"] >= 1
    assert profile.facts["environment"]["python"]


def test_the_spread_of_the_rate_is_what_independent_gaps_do_not_explain() -> None:
    rng = np.random.default_rng(5)
    gaps = Lognormal(0.1, 0.3).sample(rng, 63, 400)
    assert rate_cv(gaps.T.tolist()) < 0.02
    assert rate_cv((gaps * rng.normal(1, 0.2, 400)).T.tolist()) == pytest.approx(0.2, abs=0.02)
    assert rate_cv([[0.1, 0.2]]) == 0


def test_a_profile_is_not_overwritten_unless_forced(tmp_path: Path) -> None:
    recorded = recording(Lognormal(0.1, 0.2), 3, 5)
    path = saved(tmp_path / "new" / "board.toml", recorded)
    before = path.read_text()
    tables = document(CaptureConfig(name="board", requests=5, warmup=0, seed=9), recorded, MODEL, [])
    with pytest.raises(UsageError, match=r"board\.toml exists already; give another NAME or `output`, or `force`"):
        write_profile(tables, path, force=False)
    assert path.read_text() == before
    write_profile(tables, path, force=True)
    assert path.read_text() != before


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"`output`: cannot write .*file/board\.toml"):
        saved(tmp_path / "file" / "board.toml", recording(Lognormal(0.1, 0.2), 3, 5))


def test_answers_too_short_to_time_say_what_to_do() -> None:
    short = [TimedAnswer(10**8, [10**7] * 3) for _ in range(12)]
    with pytest.raises(
        EngineError, match="the answers were short: 30 gaps in 10 requests, a profile needs 40; give more"
    ):
        document(CaptureConfig(name="board", requests=10, warmup=2), short, MODEL, [])


class Asked(EchoEngine):
    """Remembers its requests."""

    requests: list[Request]

    def generate(self, request: Request) -> Any:
        self.requests.append(request)
        return super().generate(request)


def test_every_request_is_about_another_picture_with_another_seed() -> None:
    engine = Asked(EngineConfig(name="echo"))
    engine.requests = []
    timings = answers(engine, CaptureConfig(name="x", size=(64, 48), tokens=5, seed=3))
    timed = [next(timings) for _ in range(4)]
    assert all(len(answer.gaps_ns) == 4 and answer.ttft_ns > 0 for answer in timed)
    assert [request.seed for request in engine.requests] == [3, 4, 5, 6]
    frames = [request.images[0] for request in engine.requests]
    assert {(frame.encoding, frame.data.shape) for frame in frames} == {("rgb8", (48, 64, 3))}
    assert len({frame.data.tobytes() for frame in frames}) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "`name`: '' should be"),
        ({"name": ".hidden"}, "`name`: '.hidden' should be"),
        ({"requests": 0}, "`requests`: 0 should be"),
        ({"warmup": -1}, "`warmup`: -1 should be"),
        ({"requests": 3, "tokens": 14}, "`requests` 3 of `tokens` 14 make 39 gaps; a profile needs 40"),
    ],
)
def test_settings_without_sense_name_their_field(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        CaptureConfig(**{"name": "x", **changes})


def test_a_capture_of_a_replayed_recording_is_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In virtual time; how well a parametric replay meets such recordings is judged above, at fixed seeds."""
    recorded = recording(PAUSES, 1, 12)
    clock = VirtualClock()
    monkeypatch.setattr(run, "now_ns", clock.now_ns)
    path = saved(tmp_path / "board.toml", recorded)
    engine = ReplayEngine(EngineConfig(name="replay", profile=str(path), gaps="trace"), clock)
    captured = list(islice(answers(engine, CaptureConfig(name="x", size=(64, 48), tokens=64)), 10))
    assert [answer.gaps_ns for answer in captured] == [answer.gaps_ns for answer in recorded[2:]]
    ttft_s = np.array([answer.ttft_ns for answer in captured]) / 1e9
    assert ttft_s.mean() == pytest.approx(0.5, rel=0.1)
