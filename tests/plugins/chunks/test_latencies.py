"""Where latencies come from, as people write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.latencies import Source, sources, split
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


def test_a_number_a_family_and_a_recording_are_sources(tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text("latency_ns\n5\n7\n")
    assert drawn("2.5", 3).tolist() == [2_500_000] * 3
    assert drawn("lognormal:mean_ms=80,cv=0.5").mean() == pytest.approx(80 * MS, rel=0.05)
    recorded = one(str(file)).recorded_ns
    assert recorded.tolist() == [5, 7]


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


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("-1", "`latency`: -1 should be between 0 and 3.6e+06 ms"),
        ("none.csv", "cannot read none.csv"),
    ],
)
def test_what_is_no_source_is_one_line_that_names_it(written: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        list(sources(written, 1))
    assert message in str(error.value)
