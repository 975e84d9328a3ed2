"""Where latencies come from, as people write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from s2a_bench.boards.gaps import Lognormal, Markov
from s2a_bench.errors import UsageError
from s2a_bench.experiments.chunks.delays import read_delays
from s2a_bench.experiments.chunks.latencies import Source, sources, split
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


@pytest.mark.parametrize(("written", "ns"), [("40", 40 * MS), ("0", 0), ("2.5", 2_500_000)])
def test_a_number_is_constant_milliseconds(written: str, ns: int) -> None:
    assert drawn(written, 3).tolist() == [ns] * 3


def test_a_family_has_its_mean_in_milliseconds() -> None:
    assert one("lognormal:mean_ms=80,cv=.5").gaps == Lognormal(0.08, 0.5)
    assert drawn("lognormal:mean_ms=80,cv=0.5").mean() == pytest.approx(80 * MS, rel=0.05)
    assert drawn("bursty:mean_ms=80,cv=0.1,burst_tokens=4,within=.5").mean() == pytest.approx(80 * MS, rel=0.05)


def test_bimodal_latencies_are_pauses_that_come_alone() -> None:
    found = one("bimodal:mean_ms=80,cv=.1,pause_share=.2,pause_ratio=4").gaps
    assert found == Markov(0.08, 0.1, 0.2, 4, 1 / 0.8)
    long = drawn("bimodal:mean_ms=80,cv=.05,pause_share=.2,pause_ratio=4", 20_000) > 100 * MS
    assert long.mean() == pytest.approx(0.2, abs=0.02)
    assert long[1:][long[:-1]].mean() == pytest.approx(0.2, abs=0.03)


def test_a_profile_takes_as_long_as_its_tokens() -> None:
    latency_s = drawn("rtx-4080", 500) / 1e9
    assert latency_s.mean() == pytest.approx(0.05 + 112 / 34.2, rel=0.05)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("latency_ns\n5\n7\n", [5, 7]),
        ("request,latency_ms\n0,1.5\n1,2\n", [1_500_000, 2_000_000]),
        ("latency_s\n0.25\n", [250_000_000]),
        ("observation_ns,received_ns,d\n10,30,0\n20,25,0\n", [20, 5]),
    ],
)
def test_a_csv_file_is_played_in_its_order(text: str, expected: list[int], tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text(text)
    assert read_delays(file).tolist() == expected
    found = one(str(file)).recorded_ns
    assert found is not None
    assert found.tolist() == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "has the columns a, b; it needs observation_ns and received_ns, or one of latency_ns"),
        ("", "has the columns none"),
        ("latency_ns\n", "has no rows"),
        ("latency_ms\n1\nsoon\n", "line 3: the latency is no number"),
        ("latency_ms\n-1\n", "line 2: a latency of -1e+06 ns should be between 0 and an hour"),
        ("latency_ms\nnan\n", "line 2: a latency of nan ns"),
        ("observation_ns,received_ns\n5\n", "line 2: the latency is no number"),
    ],
)
def test_a_csv_file_that_is_wrong_is_named_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text(text)
    with pytest.raises(UsageError, match=r"`latency`: .*delays.csv") as error:
        read_delays(file)
    assert message in str(error.value)


def test_a_run_gives_each_cell_until_its_last_token_without_warm_ups(make_run: MakeRun) -> None:
    run = make_run(n=6, n_tokens=3)
    found = {source.name: source.recorded_ns for source in sources(str(run.path), 1)}
    assert list(found) == [f"{run.path}#{cell}" for cell in run.samples["cell"].unique()]
    good = run.samples[~run.samples["warmup"]].set_index("request_id")
    times = run.tokens.groupby("request_id")["client_ns"]
    whole_ns = good["e2e_ns"] + (times.max() - times.min()).reindex(good.index).fillna(0)
    for name, latency_ns in found.items():
        assert latency_ns is not None
        assert latency_ns.tolist() == whole_ns[good["cell"] == name.partition("#")[2]].tolist()


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("-1", "`latency`: -1 should be between 0 and 3.6e+06 ms"),
        ("nan", "should be between 0"),
        ("fast", "`latency`: 'fast' should be a number of ms, a family, a .csv file, a run folder, or a profile"),
        ("normal:mean_ms=4", "`latency`: 'normal' is none of the families constant, lognormal"),
        ("lognormal:cv=.5", "mean_ms should be above 0"),
        ("lognormal:mean_ms=80", "cv: missing; lognormal gaps need it"),
        ("lognormal:mean_ms=80,cv=big", "'cv=big' should be key=number"),
        ("lognormal:mean_ms=80,cv=.5,speed=2", "speed: lognormal gaps have no such key"),
        ("none.csv", "cannot read none.csv"),
    ],
)
def test_what_is_no_source_is_one_line_that_names_it(written: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        list(sources(written, 1))
    assert message in str(error.value)
