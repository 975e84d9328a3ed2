"""Where latencies come from, as people write it; and delays for others: what is written, and that it is read back."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.boards.latency import read_delays
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.chunks.rows import REQUESTS
from s2a_bench.plugins.chunks.chunks.run import run_virtual
from s2a_bench.plugins.chunks.latencies import COLUMNS, Source, sources, split, write_delays
from s2a_bench.plugins.chunks.modes import ControlSetting, mode
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from tests.made_runs import MakeRun

MS = 1_000_000


def one(written: str) -> Source:
    (found,) = sources(written, 112)
    return found


def drawn(written: str, count: int = 2000) -> np.ndarray:
    return one(written).draw(np.random.default_rng(0), count)


def test_commas_stand_between_sources_and_between_the_parameters_of_a_family() -> None:
    assert split(
        "40, lognormal:mean_ms=80,cv=.5,runs/a.csv,runs/b#ros/topic?payload=yuyv,"
        "bursty:mean_ms=9,cv=0,burst_tokens=3,within=.1"
    ) == (
        "40",
        "lognormal:mean_ms=80,cv=.5",
        "runs/a.csv",
        "runs/b#ros/topic?payload=yuyv",
        "bursty:mean_ms=9,cv=0,burst_tokens=3,within=.1",
    )
    assert split("40,40,60") == ("40", "60")
    assert split((40, "60")) == ("40", "60")


def test_a_profile_takes_as_long_as_its_tokens() -> None:
    latency_s = drawn("rtx-4080", 500) / 1e9
    assert latency_s.mean() == pytest.approx(0.05 + 112 / 34.2, rel=0.05)


def test_a_run_gives_each_cell_until_its_last_token_without_warm_ups(make_run: MakeRun) -> None:
    run = make_run(n=6, n_tokens=3)
    found = {source.name: source.recorded_ns for source in sources(str(run.path), 1)}
    assert list(found) == [f"{run.path}#{cell}" for cell in run.samples["cell"].unique()]
    good = run.samples[~run.samples["warmup"]].set_index("request_id")
    times = run.tokens.groupby("request_id")["client_ns"]
    whole_ns = good["e2e_ns"] + (times.max() - times.min()).reindex(good.index).fillna(0)
    for name, latency_ns in found.items():
        assert latency_ns.tolist() == whole_ns[good["cell"] == name.partition("#")[2]].tolist()


def exported(folder: Path, **options: Any) -> list[dict[str, str]]:
    file = folder / "delays.csv"
    settings = {"rules": "", **options}
    run_virtual(ChunksVirtual(export_delays=file, **settings), folder / "runs", NullProgress())
    with file.open(newline="") as text:
        return list(csv.DictReader(text))


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_drawn_latencies_are_written_with_their_d_and_read_back(rounding: str, tmp_path: Path) -> None:
    rows = exported(tmp_path, modes="queue?trigger=4", cycles=300, rounding=rounding)
    assert tuple(rows[0]) == COLUMNS
    assert [row["request"] for row in rows] == [str(place) for place in range(300)]
    for row in rows:
        latency_ns, tick_ns = int(row["latency_ns"]), int(row["delta_t_ns"])
        assert latency_ns == int(row["received_ns"]) - int(row["observation_ns"])
        assert int(row["d"]) == (latency_ns // tick_ns if rounding == "floor" else -(-latency_ns // tick_ns))
        assert row["rounding"] == rounding
        assert (row["sent_ns"], row["server_in_ns"], row["bytes"]) == ("", "", "")
        assert row["provenance"] == "none/none/emulated/clock-virtual"
    assert read_delays(tmp_path / "delays.csv").tolist() == [int(row["latency_ns"]) for row in rows]


def test_what_is_replayed_is_what_was_exported(tmp_path: Path) -> None:
    first = {"modes": "queue?trigger=4", "rules": "", "cycles": 200}
    one = read_run(run_virtual(ChunksVirtual(export_delays=tmp_path / "d.csv", **first), tmp_path, NullProgress()))
    again = read_run(run_virtual(ChunksVirtual(latency=str(tmp_path / "d.csv"), **first), tmp_path, NullProgress()))
    columns = [name for name in one.table(REQUESTS).columns if name != "cell"]
    assert len(one.table(REQUESTS))
    assert one.table(REQUESTS)[columns].equals(again.table(REQUESTS)[columns])


def test_of_a_measured_run_the_times_of_its_marks_are_written_in_their_order(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(n=8)
    cell = str(run.samples["cell"].iloc[0])
    rows = exported(tmp_path, latency=f"{run.path}#{cell}")
    assert len(rows) == 8
    for row in rows:
        times = [int(row[name]) for name in ("observation_ns", "sent_ns", "server_in_ns", "server_out_ns")]
        assert times == sorted(times)
        assert times[-1] <= int(row["received_ns"])
        assert "emulated" not in row["provenance"]


def test_a_run_has_to_be_told_which_of_its_cells(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(n=4)
    with pytest.raises(UsageError, match=r"`export_delays`: 5 sources of `latency`, .*; name one of them"):
        exported(tmp_path, latency=str(run.path))
    with pytest.raises(UsageError, match="has no cell 'pigeon', only "):
        exported(tmp_path, latency=f"{run.path}#pigeon")


def test_a_place_that_is_none_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    for file in (tmp_path / "none" / "d.csv", tmp_path / "d.txt"):
        with pytest.raises(UsageError, match=r"`export_delays`: .* should be a \.csv file in a folder that there is"):
            ChunksVirtual(export_delays=file)
    (tmp_path / "d.csv").mkdir()
    with pytest.raises(StoreError, match="`export_delays`: cannot write"):
        write_delays(tmp_path / "d.csv", one("40"), np.empty(0, np.int64), mode("sync"), ControlSetting(20 * MS, 16))
