"""What every seeded generator draws first: renaming a class or a field changes no figure."""

from __future__ import annotations

import zlib
from itertools import islice

import numpy as np
import pytest

from s2a_bench.boards.gaps import Lognormal
from s2a_bench.boards.latency import read_latency, sequence_ns
from s2a_bench.frames.synthetic import render_scene
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.replay import ReplayEngine
from s2a_bench.policy import PlanShape, Timing
from s2a_bench.stats.batches import Rows
from s2a_bench.stats.change import change_between
from s2a_bench.stats.seeds import generator
from s2a_bench.sweep.file import rounds
from s2a_bench.testing.engine import ask
from studies.worlds import World

SETTING = PlanSetting("rtx-4080", "RTX 4080", 34.2, 0.3, 6, 8, 1.0)
SHAPE = PlanShape(8, 6, Timing(1.0, 0.8, 1.5), 0.2)
WORLD = World(10.0, 0.5, 6, 8, 1.0)


@pytest.mark.parametrize(
    ("key", "first"),
    [
        (("boundary", "rtx-4080"), 0.7337096510429988),
        (("timeline", "prior", SETTING.key), 0.12025021033456473),
        (("tracking", SHAPE.key), 0.641242387475025),
        (("chunks", "x"), 0.3017693406439116),
        (("chunks events",), 0.1532940364127956),
        (("ccrb", "random"), 0.9272297457463737),
        (("jitter", WORLD.key), 0.004325829547535132),
        (("jitter", World(10.0, 0.5, 6, 8, 1.0, Lognormal(0.1, 0.3)).key), 0.7094527957035938),
        (("shift", WORLD.key, "gamma"), 0.5170253114215696),
        (("drift", WORLD.key, "none"), 0.022378702027331387),
    ],
)
def test_a_cells_draws_follow_from_the_text_of_its_key(key: tuple[str, ...], first: float) -> None:
    assert generator(0, *key).random() == first
    assert generator(1, *key).random() != first


def test_other_seeded_draws() -> None:
    assert zlib.crc32(render_scene(64, 48, 3).tobytes()) == 629266562
    assert [item for _, item in rounds("abcdef", 1, 7)] == ["c", "d", "f", "b", "e", "a"]
    latencies = read_latency("lognormal:mean_ms=80,cv=0.2")
    assert list(islice(sequence_ns(latencies), 3)) == [80_424_284, 76_420_726, 89_054_362]
    assert World(10.0, 0.5, 2, 2, 1.0).draw(generator(0, "a"), 2).arrival_s.tolist() == [
        [0.6739093793962383, 0.6058667073534734],
        [0.8614584001240284, 0.9042071422784913],
    ]


def test_an_engine_that_replays_says_the_same_for_a_seed() -> None:
    engine = ReplayEngine(EngineConfig(name="replay", profile="rtx-4080"))
    assert "".join(piece.text for piece in ask(engine, max_tokens=12, seed=5)) == "1. close(bottle)\n2. go_to(sofa)\n"


def test_intervals_are_the_same_each_time() -> None:
    values = np.random.default_rng(0).normal(1, 0.1, 60)
    ratio = change_between([Rows(values)], [Rows(values[::-1] * 1.1)], "median", seed=0).ratio
    assert (ratio.low, ratio.high) == pytest.approx((1.0398277347860516, 1.1636542857254737))
