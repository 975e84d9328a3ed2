"""Predictions: service times as users write them, and a knee that is known."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import s2a_bench as s2a
from s2a_bench.errors import S2AError
from s2a_bench.plugins.chunks.capacity import predict
from s2a_bench.plugins.chunks.capacity.predict import Service, read_batches
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES
from s2a_bench.store.run import StoredRun, read_run
from tests.made_runs import BLACK_BOX, MakeRun

MS = 1_000_000


def first(service: Service, count: int = 3, seed: int = 0) -> list[tuple[int, ...]]:
    return [*map(tuple, islice(service.times(np.random.default_rng(seed)), count))]


def predicted(tmp_path: Path, **options: Any) -> StoredRun:
    return read_run(s2a.capacity(mode="predicted", output=tmp_path, seconds=5, settle_s=3, **options).path)


def knee(run: StoredRun) -> tuple[int, int, int]:
    ((robots, low, high),) = run.table(KNEES)[["robots", "low", "high"]].to_numpy().tolist()
    return robots, low, high


def test_the_engine_s_time_of_a_run_is_the_service_and_the_queue_is_no_part_of_it(make_run: MakeRun) -> None:
    cell = {"capture": 1.0, "queue": 5.0, "inference": 20.0, "return": 2.0}
    run = make_run({"ours": cell, "theirs": BLACK_BOX}, n=4, spread=0)
    ours = Service.read(f"{run.path}#ours")
    assert first(ours) == [(20 * MS, 20 * MS, 7 * MS)] * 3, "4 ms more for three tokens"
    theirs = Service.read(f"{run.path}#theirs")
    assert first(theirs) == [(302_500_000, 306_500_000, 0)] * 3
    assert theirs.mean_ns == 306_500_000
    assert "the server sends no marks" in theirs.about
    assert "predicts more stalls and fewer robots than there are" in theirs.about
    with pytest.raises(S2AError, match=r"`predict`: .* has several cells; name one of .*#ours, .*#theirs"):
        Service.read(str(run.path))


def test_a_recording_keeps_its_order_from_a_random_request_on(tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text("latency_ms\n" + "\n".join(map(str, range(1, 8))))
    service = Service.read(str(file))
    starts = set()
    for seed in range(9):
        times = [whole_ns // MS for _, whole_ns, _ in first(service, 14, seed)]
        assert times == [(times[0] - 1 + place) % 7 + 1 for place in range(14)]
        starts.add(times[0])
    assert len(starts) > 2


def test_a_batch_takes_the_time_between_those_of_its_neighbours(tmp_path: Path) -> None:
    file = tmp_path / "batch.csv"
    file.write_text("batch,latency_ms\n1,50\n4,80\n")
    assert read_batches(file) == pytest.approx([1, 1.2, 1.4, 1.6])


@pytest.mark.parametrize(
    "text", ["batch,latency_ms\n2,50\n", "latency_ms\n50\n", "batch,latency_ms\n1,9\n1,9\n", "batch,latency_ms\n1,0\n"]
)
def test_batches_that_make_no_sense_are_one_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "batch.csv"
    file.write_text(text)
    with pytest.raises(S2AError, match=r"^`batch`: .*batch\.csv needs a column batch, 1 and larger sizes"):
        read_batches(file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"predict": "0"}, "`predict`: 0 takes no time"),
        ({"predict": "none.csv"}, "`predict`: cannot read none.csv"),
        ({"predict": "jetson-agx-orin"}, "`predict`: .* is a profile of tokens"),
        ({"predict": "20", "plan_every_s": 2, "limit": "ttft_p99=1s"}, "`limit`: .* have no first piece"),
        ({"predict": "20", "robots": "10000", "seconds": 3600}, "`seconds`: 10000 robots for 36.. s are over"),
    ],
)
def test_what_cannot_be_predicted_is_one_line(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(S2AError, match=message):
        s2a.capacity(mode="predicted", output=tmp_path, **options)


def test_the_knee_of_a_queue_is_exact(tmp_path: Path) -> None:
    run = predicted(tmp_path, predict="20", modes="queue?trigger=2", robots="1..64")
    assert knee(run) == (16, 16, 16)
    fleets = run.table(FLEETS).set_index("robots")
    assert set(fleets["source"]) == {"predicted"}
    assert fleets["stalled"][16] == 0
    assert fleets["stalled"][17] == pytest.approx(1 / 17, abs=0.01)
    assert [*fleets.index] == [1, 2, 4, 8, 16, 32, 24, 20, 18, 17]


def test_the_predicted_knee_is_the_median_of_five_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options: Any = {"predict": "lognormal:mean_ms=20,cv=1", "robots": "1..64", "modes": "queue?trigger=8"}
    median, low, _ = knee(predicted(tmp_path / "all", **options, seed=7))
    monkeypatch.setattr(predict, "SEEDS", 1)
    alone = [predicted(tmp_path / str(seed), **options, seed=seed).table(KNEES)["robots"][0] for seed in range(7, 12)]
    assert len({*alone}) > 2, alone
    assert median == low == sorted(alone)[2]


def test_the_limit_of_sync_is_on_what_is_beyond_one_robot_alone(tmp_path: Path) -> None:
    run = predicted(tmp_path, predict="30", modes="sync", robots="1,2,40")
    fleets = run.table(FLEETS).set_index("robots")
    assert fleets["stalled_alone"][40] == fleets["stalled"][1] == pytest.approx(1 / 17, abs=0.01)
    assert fleets["within"].tolist() == [True, True, False]
    assert knee(run) == (2, 2, 39)
    assert run.table(KNEES)["limit"].tolist() == ["at most 1 % stalled ticks beyond those of one robot alone"]


def test_no_robot_is_predicted_where_one_leaves_no_room_and_nothing_where_nothing_is_known(tmp_path: Path) -> None:
    full = predicted(tmp_path / "full", predict="700", modes="sync", robots="1..8", limit="stalled=50%")
    assert knee(full) == (0, 0, 0)
    slow = predicted(tmp_path / "slow", predict="20000", modes="sync", robots="1..8", limit="latency_p99=30s")
    assert slow.table(KNEES)["robots"].tolist() == [0]
    assert slow.table(KNEES)["high"].isna().all()


def test_one_robot_is_tried_before_a_range_that_begins_with_more(tmp_path: Path) -> None:
    run = predicted(tmp_path, predict="25", robots="16..32")
    assert run.table(FLEETS)["robots"].tolist() == [1, 16]
    assert knee(run) == (1, 1, 15)


def test_clients_without_a_clock_and_plans_are_predicted(tmp_path: Path) -> None:
    closed = predicted(tmp_path, predict="100", closed_loop=True, robots="1,5", servers=2)
    assert closed.table(FLEETS)["requests_per_s"].tolist() == pytest.approx([10, 20], rel=0.02)
    assert closed.table(KNEES).empty
    plans = predicted(tmp_path, predict="250", plan_every_s=1, robots="1..16", limit="latency_p99=1s")
    assert plans.table(KNEES)["robots"].tolist() == [4]


def test_a_predicted_percentile_is_judged_by_its_interval(tmp_path: Path) -> None:
    run = predicted(tmp_path, predict="20", modes="queue?trigger=8", robots="1,4,40", limit="latency_p50=60ms")
    assert run.table(FLEETS)["verdict"].tolist() == ["undecided", "below", "above"]
