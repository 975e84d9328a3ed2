"""The numbers, tables and figures of a throughput run made by hand."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from matplotlib.patches import Rectangle

from s2a_bench.experiments.requests import RequestCell
from s2a_bench.experiments.throughput.metrics import (
    BIN,
    REFERENCE,
    ReferenceRow,
    joined,
    rates_by_position,
    throughput_cells,
    throughput_csv,
    throughput_json,
)
from s2a_bench.experiments.throughput.view import (
    position_table,
    show,
    speed_table,
    throughput_figures,
    throughput_sentences,
)
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.style import paper_column
from tests.made_runs import SCHEMA, known

MakeRow = Callable[..., SampleRow]
Make = Callable[..., StoredRun]

PATHS: Mapping[str, Mapping[str, float]] = {
    "in-process": {"capture": 1, "inference": 100, "return": 0},
    "http/as-deployed": {"capture": 1, "network": 5, "inference": 100, "return": 5},
}


@pytest.fixture
def make(tmp_path: Path, make_row: MakeRow) -> Make:
    """Make a run: gaps in ms a cell, the same in every request; ``facts`` a cell; llama-bench's rates a block."""

    def made(
        gaps: Mapping[str, Sequence[float]],
        *,
        n: int = 3,
        facts: Mapping[str, Mapping[str, float]] | None = None,
        reference: Sequence[float] = (),
        **manifest: Any,
    ) -> StoredRun:
        with RunWriter.create(tmp_path, "throughput", known(manifest)) as run:
            for block in range(-1, n):
                for name, ms in gaps.items():
                    engine = "llama-server" if name == "http/llama-server" else "llama"
                    row = make_row(name, PATHS.get(name, PATHS["http/as-deployed"]), block, engine=engine)
                    pipeline = "loopback" if name == "in-process" else name.partition("/")[0]
                    own_facts = dict((facts or {}).get(name, {}))
                    row = replace(row, pipeline=pipeline, warmup=block < 0, n_tokens=len(ms) + 1, facts=own_facts)
                    run.sample(row)
                    times = [row.marks[-1][1]]
                    for gap in ms:
                        times.append(times[-1] + round(gap * 1e6))
                    run.tokens(TokenRow(row.request_id, name, i, i, "x", None, at) for i, at in enumerate(times))
            for block, rate in enumerate(reference, -1):
                took = round(100 / rate * 1e9)
                run.append(REFERENCE, [ReferenceRow(block, 0, block < 0, 1, 2, 100, 42, took, {})])
        return read_run(run.path)

    return made


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with paper_column():
        yield


def only(run: StoredRun) -> RequestCell:
    (cell,) = throughput_cells(run)
    return cell


def test_both_rates_by_hand(make: Make) -> None:
    # 5 tokens, 4 gaps of 20 ms: 50/s at the client; the engine says 5 tokens in 125 ms: 40/s
    facts = {"predicted_n": 5.0, "predicted_ms": 125.0, "prompt_ms": 200.0, "prompt_eval_ms": 50.0, "prompt_n": 30.0}
    cell = only(make({"in-process": [20] * 4}, facts={"in-process": {**facts, "energy_j": 2.5}}))
    assert list(cell.values("decode_tokens_per_s")) == [50.0] * 3
    assert list(cell.values("tokens_per_s")) == [40.0] * 3
    assert list(cell.values("image_ms")) == [150.0] * 3
    assert list(cell.values("prefill_tokens_per_s")) == [150.0] * 3
    assert list(cell.values("prompt_tokens")) == [30.0] * 3
    assert list(cell.values("tokens_per_joule")) == [2.0] * 3
    assert list(cell.values("ttft_ms")) == [100.0] * 3  # without the capture
    assert cell.has_engine_time
    assert list(cell.values("itl")) == [20.0] * 12


def test_the_parts_of_the_prompt_stand_side_by_side(make: Make) -> None:
    parts = {"preprocess_ms": 10.0, "vision_encode_ms": 130.0, "prompt_eval_ms": 50.0, "first_decode_ms": 21.0}
    run = make({"in-process": [20] * 4}, facts={"in-process": {"prompt_ms": 200.0, "prompt_n": 30.0, **parts}})
    assert {name: list(only(run).values(name)) for name in parts} == {name: [ms] * 3 for name, ms in parts.items()}
    table = show(run).tables["prompt"]
    assert table.rows == [("in-process", "30.0", "10.0", "130", "50.0", "200", "150", "21.0", "100", "100")]
    (cell,) = throughput_json(throughput_cells(run))["cells"]
    assert {name: cell[name]["median"] for name in parts} == parts


def test_another_engine_is_compared_by_the_engines_own_figures_too(make: Make) -> None:
    names = ("in-process", "http/as-deployed", "http/llama-server")
    facts = {name: {"predicted_n": 5.0, "predicted_ms": ms} for name, ms in zip(names, (50.0, 50.0, 62.5), strict=True)}
    run = make(dict.fromkeys(names, [10] * 4), facts=facts)
    found = [
        (ratio["metric"], ratio["of"], ratio["value"]) for ratio in throughput_json(throughput_cells(run))["ratios"]
    ]
    assert found == [
        ("decode_tokens_per_s", "http/as-deployed", 1.0),
        ("decode_tokens_per_s", "http/llama-server", 1.0),
        ("tokens_per_s", "http/llama-server", 0.8),
    ]
    assert "tokens_per_s,http/llama-server,in-process,0.8" in throughput_csv(throughput_cells(run))["ratios.csv"].text(
        run.origins
    )
    sentence = throughput_sentences(throughput_cells(run))[-1]
    assert sentence == "By their own figures the engine of http/llama-server has 0.800 of the rate of in-process."
    untold = make(dict.fromkeys(names, [10] * 4), facts={"in-process": facts["in-process"]})
    assert {ratio["metric"] for ratio in throughput_json(throughput_cells(untold))["ratios"]} == {"decode_tokens_per_s"}


def test_a_server_that_tells_nothing_has_the_clients_rate_and_no_zeros(make: Make) -> None:
    run = make({"http/as-deployed": [10] * 4})
    cell = only(run)
    assert list(cell.values("tokens_per_s")) == list(cell.values("decode_tokens_per_s")) == [100.0] * 3
    for absent in ("prompt_ms", "image_ms", "prompt_eval_ms", "prefill_tokens_per_s", "tokens_per_joule"):
        assert cell.values(absent).size == 0
    assert "the server does not report T_eval" in " ".join(speed_table(throughput_cells(run)).notes)
    (cell,) = throughput_json(throughput_cells(run))["cells"]
    assert cell["t_eval"] == "client"
    assert not {"prompt_ms", "image_ms", "tokens_per_joule"} & set(cell)


def test_tokens_that_come_together_are_counted_by_the_server(make: Make) -> None:
    run = make({"http/as-deployed": [30] * 2}, facts={"http/as-deployed": {"predicted_n": 7.0}})
    cell = only(run)
    assert list(cell.values("decode_tokens_per_s")) == [pytest.approx(100.0)] * 3  # 6 of 7 tokens in 60 ms
    assert joined(cell) == 12
    assert "12 tokens arrived together with another one" in " ".join(speed_table(throughput_cells(run)).notes)


def test_warm_ups_are_in_no_number(make: Make) -> None:
    run = make({"in-process": [10] * 3}, n=2, reference=[1.0, 80.0, 90.0])
    assert only(run).n == 2
    assert only(run).values("itl").size == 6
    reference = throughput_json(throughput_cells(run))["reference"]
    assert reference["decode_tokens_per_s"]["n"] == 2
    assert reference["decode_tokens_per_s"]["mean"] == pytest.approx(85.0)
    assert reference["depths"] == [42]


def test_a_slower_part_of_the_answer_shows_at_its_position(make: Make) -> None:
    gaps = [10.0] * (BIN - 1) + [20.0] * BIN + [40.0] * 3  # tokens 1..31, 32..63, 64..66
    found = rates_by_position(only(make({"in-process": gaps})))
    assert {place: list(rates) for place, rates in found.items()} == {
        (0, 31): [pytest.approx(100.0)] * 3,
        (32, 63): [pytest.approx(50.0)] * 3,
        (64, 95): [pytest.approx(25.0)] * 3,
    }


def test_cells_are_compared_with_in_process_and_with_llama_bench(make: Make) -> None:
    run = make({"http/as-deployed": [20] * 4, "in-process": [10] * 4}, reference=[1.0, 50.0, 80.0, 100.0])
    found = {(of, to): ratio.value for _, of, to, ratio in throughput_cells(run).rate_ratios}
    assert found == {
        ("in-process", "llama-bench"): pytest.approx(100 / 80),
        ("http/as-deployed", "llama-bench"): pytest.approx(50 / 80),
        ("http/as-deployed", "in-process"): pytest.approx(0.5),
    }
    assert [cell.name for cell in throughput_cells(run)] == ["in-process", "http/as-deployed"]


def test_a_reference_that_broke_off_is_compared_all_the_same(make: Make) -> None:
    run = make({"in-process": [10] * 4}, n=3, reference=[1.0, 50.0])
    ((*_, ratio),) = throughput_cells(run).rate_ratios
    assert ratio.value == pytest.approx(2.0)


def test_the_json_is_strict_and_valid(make: Make) -> None:
    facts = {"predicted_n": 70.0, "predicted_ms": 700.0, "prompt_ms": 20.0, "prompt_eval_ms": 5.0, "prompt_n": 9.0}
    joules = {"in-process": {**facts, "energy_j": 3.0}}
    gaps = {"in-process": [10.0] * 69, "http/as-deployed": [11.0] * 69}
    run = make(gaps, facts=joules, reference=[9.0, 99.0, 98.0, 97.0], reference_command=["x"])
    whole = json.loads(json.dumps(throughput_json(throughput_cells(run)), allow_nan=False))
    jsonschema.validate(whole, SCHEMA, cls=jsonschema.Draft202012Validator)
    cell = whole["cells"][0]
    assert cell["tokens_per_s"]["mean"] == pytest.approx(100.0)
    assert cell["positions"][2]["first"] == 64
    assert [ratio["metric"] for ratio in whole["ratios"]] == ["decode_tokens_per_s"] * 3
    del cell["positions"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(whole, SCHEMA, cls=jsonschema.Draft202012Validator)


def test_answers_of_one_bin_have_no_table_of_positions(make: Make) -> None:
    assert position_table(throughput_cells(make({"in-process": [7] * 3}))) is None


def test_bars_start_at_zero_and_the_papers_are_labelled(make: Make) -> None:
    run = make({"in-process": [25] * 4}, n=2, model={"dummy": True})
    figure = throughput_figures(throughput_cells(run))["throughput_bars"]()
    bars = [patch.get_width() for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]
    assert bars == [pytest.approx(40.0)]
    assert figure.axes[0].get_xlim()[0] == 0
    assert "Dummy weights." in caption_of(figure)
    assert not figure.legends
    beside = throughput_figures(throughput_cells(run), against="paper")["throughput_bars"]()
    names = [label.get_text() for label in beside.axes[0].get_yticklabels()]
    assert names == ["in-process", "paper:\nRTX 4080", "paper:\nJetson AGX Orin", "paper:\nJetson Orin Nano"]
    assert [text.get_text() for text in beside.axes[0].texts] == ["40.0", "34.2", "4.8", "0.58"]
    assert [text.get_text() for legend in beside.legends for text in legend.get_texts()] == [
        "the paper's claim (table II), other machines"
    ]
    assert beside.axes[0].get_xscale() == "log"
    assert not [patch for patch in beside.axes[0].patches if isinstance(patch, Rectangle)]  # no bar without a zero


def test_one_late_burst_does_not_hide_the_rates(make: Make) -> None:
    run = make({"in-process": [10.0] * 40 + [0.001] * 23}, n=1)
    figure = throughput_figures(throughput_cells(run))["positions"]()
    gaps = throughput_figures(throughput_cells(make({"in-process": [10.0] * 40})))["gaps"]()
    assert gaps.axes[0].get_xscale() == "linear"
    assert throughput_figures(throughput_cells(make({"in-process": []}))) == {}
    (line,) = figure.axes[0].get_lines()
    medians: Any = line.get_ydata()
    assert medians[0] == pytest.approx(100.0)
    assert figure.axes[0].get_ylim()[1] == pytest.approx(1.5 * max(medians))
