import csv
import io
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.cli.experiment import present
from s2a_bench.errors import StoreError
from s2a_bench.experiments import write_shown
from s2a_bench.experiments.latency import EXPERIMENT
from s2a_bench.experiments.latency.metrics import latency_csv
from s2a_bench.experiments.latency.view import group_table, show, stage_table, summary_table
from s2a_bench.experiments.requests import cells_of
from s2a_bench.stats import Ratio, Summary
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.trace import path_of
from s2a_bench.writers.latex import to_latex
from s2a_bench.writers.tables import TextTable, interval, mean_sd, number, to_markdown
from tests.made_runs import STAGES, MakeRun, known

NONE = "\N{EN DASH}"
HAND = {
    "http/as-deployed": {"capture": 1, "image_encode": 3, "base64_encode": 2, "network": 18, "inference": 100, "": 1.5},
    "ros/topic": {"capture": 1, "cdr_pack": 0.0124, "network": 3, "inference": 100},
}
HAND = {name: {**stages, "return": 0.5} for name, stages in HAND.items()}


def printed(run: StoredRun, width: int = 100) -> str:
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setenv("COLUMNS", str(width))
        present(run, EXPERIMENT.show(run))
    return out.getvalue()


def medians(table: TextTable) -> list[tuple[str, ...]]:
    """Return the rows of a table without the mean ± sd in brackets."""
    return [tuple(text.partition(" (")[0] for text in row) for row in table.rows]


def test_without_model_reads_as_a_sum_where_it_is_told(make_run: MakeRun) -> None:
    ours = {"capture": 1, "network": 3, "preprocess": 20, "inference": 80, "return": 0.5}
    theirs = {"capture": 1, "json_pack": 2, "ingest": 30, "inference": 81}
    cells = {"http/llama-server": theirs, "ros/topic": ours}
    run = make_run(cells, n=4, spread=0, manifest={"stages": path_of([STAGES])}, server_prompt_ms=80.0)
    assert medians(stage_table(cells_of(run)))[-5:] == [
        ("", "e2e without inference", "33.0", "4.50"),
        ("", "preprocess", NONE, "20.0"),
        ("", "e2e without model", "34.0", "24.5"),
        ("", "inference", "81.0", "80.0"),
        ("", "e2e", "114", "104"),
    ]
    assert group_table(cells_of(run)).header[-5:] == ("e2e w/o infer.", "preproc.", "e2e w/o model", "infer.", "e2e")
    assert "e2e less the prompt_ms it reports, which is assumed to be all" in " ".join(printed(run).split())
    (sentence,) = show(run).sentences
    assert sentence == "Without model, http/llama-server takes 1.39 times as long as ros/topic (raw)."


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0.000"),
        (0.00049, "0.000"),
        (0.1234, "0.123"),
        (0.9996, "1.00"),
        (9.994, "9.99"),
        (9.996, "10.0"),
        (12.34, "12.3"),
        (99.96, "100"),
        (1234.4, "1234"),
    ],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_mean_and_sd_share_their_decimals() -> None:
    assert mean_sd(Summary(50, 0, 101.84, 8.63, 0, 0)) == "102 ± 9"
    assert mean_sd(Summary(50, 0, 15.52, 1.04, 0, 0)) == "15.5 ± 1.0"
    assert mean_sd(Summary(1, 0, 15.52, None, 0, 0)) == "15.5"


def test_a_ratio_without_bounds_or_value_says_so() -> None:
    assert interval(Ratio(6.57, 6.2, 6.904)) == "6.57 [6.20, 6.90]"
    assert interval(Ratio(6.57, None, None)) == "6.57"
    assert interval(Ratio(None, None, None)) == interval(None) == NONE


def test_the_stage_table_by_hand(make_run: MakeRun) -> None:
    table = stage_table(cells_of(make_run(HAND, n=4, spread=0)))
    assert table.header == ("group", "stage", "http/as-deployed", "ros/topic")
    assert medians(table) == [
        ("capture", "capture", "1.00", "1.00"),
        ("encode", "image_encode", "3.00", NONE),
        ("", "base64_encode", "2.00", NONE),
        ("pack", "cdr_pack", NONE, "0.012"),
        ("network", "network", "18.0", "3.00"),
        ("return", "return", "0.500", "0.500"),
        ("", "residual", "1.50", "0.000"),
        ("", "e2e without inference", "26.0", "4.51"),
        ("", "inference", "100", "100"),
        ("", "e2e", "126", "105"),
    ]
    assert table.notes == (
        "n = 4 samples a cell, warm-ups left out.",
        "640x480; payload: raw; request mode.",
        "Echo engine.",
        "4 of 8 samples have a residual above 5% of e2e without inference.",
    )
    assert table.rows[1][2] == "3.00 (3.00 ± 0.00)"


def test_the_group_table_has_a_row_a_cell(make_run: MakeRun) -> None:
    table = group_table(cells_of(make_run(HAND, n=4, spread=0)))
    assert table.header == ("cell", "capture", "encode", "pack", "network", "return", "e2e w/o infer.", "infer.", "e2e")
    assert table.rows == [
        ("http/as-deployed", "1.00", "5.00", NONE, "18.0", "0.500", "26.0", "100", "126"),
        ("ros/topic", "1.00", NONE, "0.012", "3.00", "0.500", "4.51", "100", "105"),
    ]


def test_the_summary_table_by_hand(make_run: MakeRun, make_row: Callable[..., SampleRow]) -> None:
    loopback = {"loopback": {"capture": 1, "inference": 100, "return": 0.3}}
    extra = (make_row("loopback", loopback["loopback"], 9, error="x"),)
    table = summary_table(cells_of(make_run(HAND | loopback, n=5, spread=0, extra=extra)))
    assert table.header[-2:] == ("ratio to ros/topic", "ratio to loopback")
    assert table.rows == [
        ("http/as-deployed", "5", "0", "26.0 ± 0.0", "26.0", "26.0", "26.0", "5.76 [5.76, 5.76]", "20.0 [20.0, 20.0]"),
        ("ros/topic", "5", "0", "4.51 ± 0.00", "4.51", "4.51", "4.51", "1", "3.47 [3.47, 3.47]"),
        ("loopback", "5", "1", "1.30 ± 0.00", "1.30", "1.30", "1.30", NONE, "1"),
    ]
    failed, launch = table.notes[-2:]
    assert failed == "1 samples failed and are in no number here; samples.csv says why."
    assert launch.startswith("The intervals hold for this launch only")


BLOCKS = {
    **{name: HAND[name] for name in ("http/as-deployed", "ros/topic")},
    "http/as-deployed?payload=jpeg": {"capture": 1, "network": 8, "inference": 100, "return": 1},
    "ros/topic?payload=jpeg": {"capture": 1, "network": 3, "inference": 100, "return": 1},
}


def test_payloads_are_blocks_and_ratios_stay_inside_them(make_run: MakeRun) -> None:
    run = make_run(BLOCKS, n=4, spread=0)
    table = summary_table(cells_of(run))
    figures = "n", "errors", "mean ± sd", "median", "p90", "p99"
    assert table.header == ("payload", "cell", *figures, "ratio to ros/topic")
    assert [(*row[:2], row[5], row[8].split()[0]) for row in table.rows] == [
        ("raw", "http/as-deployed", "26.0", "5.76"),
        ("", "ros/topic", "4.51", "1"),
        ("jpeg", "http/as-deployed", "10.0", "2.00"),
        ("", "ros/topic", "5.00", "1"),
    ]
    assert table.rules == {2}
    assert stage_table(cells_of(run)).header[2:] == (
        *("http/as-deployed raw", "ros/topic raw"),
        *("http/as-deployed jpeg", "ros/topic jpeg"),
    )
    assert show(run).sentences == [
        f"Without inference, http/as-deployed takes {times} times as long as ros/topic ({payload})."
        for times, payload in (("5.76", "raw"), ("2.00", "jpeg"))
    ]


def test_a_sentence_says_what_takes_longer_and_where_no_difference_is_shown(make_run: MakeRun) -> None:
    in_process = {"loopback": {"capture": 1, "inference": 100, "return": 0.3}}
    sentence, launch = show(make_run(HAND | {"http/binary": HAND["ros/topic"]} | in_process, n=5, spread=0)).sentences
    assert sentence == (
        "Without inference, http/as-deployed takes 5.76 [95 %: 5.76, 5.76] times as long as ros/topic (raw); "
        "no difference is shown for http/binary 1.00 [1.00, 1.00]."
    )
    assert launch.startswith("The intervals hold for this launch only")
    alone = dict.fromkeys(("http/binary", "ros/topic"), HAND["ros/topic"])
    (none, _) = show(make_run(alone, n=5, spread=0)).sentences
    assert none.startswith("Without inference, no difference from ros/topic (raw) is shown for http/binary")
    assert "as long as loopback" in show(make_run(in_process | {"ros/topic": HAND["ros/topic"]}, n=5)).sentences[0]


@pytest.mark.parametrize("named", [True, False])
def test_unlike_payloads_are_compared_where_a_name_has_its_payload(make_run: MakeRun, named: bool) -> None:
    names = ("http?payload=jpeg", "ros") if named else ("http", "ros")
    run = make_run(HAND, n=4, spread=0, payloads={"http": "jpeg"}, manifest={"configuration": {"transports": names}})
    said = "http/as-deployed (jpeg) takes 5.76 times as long as ros/topic (raw)"
    assert any(said in sentence for sentence in show(run).sentences) is named
    assert any("ratio" in name for name in summary_table(cells_of(run)).header) is named


def test_a_black_box_is_absent_where_its_inference_is_unknown(make_run: MakeRun, black_box: Any) -> None:
    run = make_run(HAND | {"http/black-box": black_box}, n=4, spread=0)
    assert summary_table(cells_of(run)).rows[1][3:] == (NONE,) * 5
    assert summary_table(cells_of(run), "e2e").rows[1][3:5] == ("302 ± 0", "302")
    assert " 302 " in printed(run)


def test_markdown_and_latex_are_tables(make_run: MakeRun) -> None:
    run = make_run(HAND, n=4, spread=0)
    table = replace(stage_table(cells_of(run)), provenance=run.origins.line)
    markdown = to_markdown(table).splitlines()
    assert markdown[0] == "**Stages in ms: median (mean ± sd)**"
    assert markdown[2:5] == [
        "| group | stage | http/as-deployed | ros/topic |",
        "| --- | --- | ---: | ---: |",
        "| capture | capture | 1.00 (1.00 ± 0.00) | 1.00 (1.00 ± 0.00) |",
    ]
    latex = to_latex(table)
    assert r"\begin{tabular}{llrr}" in latex
    assert r"encode & image\_encode & 3.00 (3.00 $\pm$ 0.00) & -- \\" in latex
    assert latex.count(r"\midrule") == 2
    assert latex.endswith(
        "\\end{tabular}\n\\par{\\footnotesize Provenance: engine UNKNOWN (the server does not report it).}\n"
    )
    # Nothing outside comments that LaTeX would take for something else.
    body = [line for line in latex.splitlines() if not line.startswith("%")]
    assert not any(char in line.replace(r"\_", "").replace(r"\%", "") for line in body for char in f"_%#±{NONE}")


def test_csv_keeps_every_digit_and_leaves_absent_stages_out(make_run: MakeRun) -> None:
    run = make_run(HAND, n=4, spread=0)
    texts = {name: table.text(run.origins) for name, table in latency_csv(cells_of(run)).items()}
    stages = list(csv.DictReader(io.StringIO(texts["stages.csv"])))
    ros = {row["stage"]: row for row in stages if row["cell"] == "ros/topic"}
    assert list(ros) == ["capture", "cdr_pack", "network", "inference", "return", "residual"]
    pack = ros["cdr_pack"]
    assert [pack[name] for name in ("provenance", "group", "n", "emulated")] == [
        *("unknown/unknown/unknown", "pack", "4", "False"),
    ]
    assert {pack[name] for name in ("median", "mean", "p90", "p99")} == {"0.0124"}
    metrics = {row["metric"] for row in csv.DictReader(io.StringIO(texts["summary.csv"]))}
    assert metrics >= {"e2e_without_inference_ms", "e2e_ms", "ttft_ms", "itl_ms", "residual_share"}
    ratio = next(csv.DictReader(io.StringIO(texts["ratios.csv"])))
    assert ratio["emulated"] == "False"
    replayed = make_run(HAND, n=4, engine="replay", manifest={"model": {"engine": "replay", "emulated": True}})
    for table in latency_csv(cells_of(replayed)).values():
        text = table.text(replayed.origins)
        assert {row["emulated"] for row in csv.DictReader(io.StringIO(text))} == {"True"}
    assert (ratio["of"], ratio["to"], float(ratio["value"])) == ("http/as-deployed", "ros/topic", 26 / 4.5124)


def test_the_table_of_tokens_has_their_gaps_and_delays(tmp_path: Path, make_row: Callable[..., SampleRow]) -> None:
    with RunWriter.create(tmp_path, "latency", known({"stages": STAGES})) as writer:
        for block in range(2):
            row = make_row("ros/topic", HAND["ros/topic"], block)
            left_ns = [10**9 + i * 5_000_000 for i in range(3)]
            writer.sample(row)
            writer.tokens(
                TokenRow(row.request_id, row.cell, i, i, "x", at_ns, at_ns + (block + 1) * 10**6)
                for i, at_ns in enumerate(left_ns)
            )
    table = show(read_run(writer.path)).tables["tokens"]
    assert table.header == ("cell", "gap median", "gap p99", "delay median", "delay p90", "delay p99")
    assert table.rows == [("ros/topic", "5.00", "5.00", "1.50", "2.00", "2.00")]


def test_a_cell_in_which_everything_failed_is_in_the_summary(
    make_run: MakeRun, make_row: Callable[..., SampleRow]
) -> None:
    run = make_run({}, extra=(make_row("ros/topic", {"capture": 1}, 1, error="lost"),))
    assert latency_csv(cells_of(run))["summary.csv"].rows == [("ros/topic", "", 1, 0, 0, *[None] * 5, False)]
    assert summary_table(cells_of(run)).rows == [("ros/topic", "0", "1", NONE, NONE, NONE, NONE)]


@pytest.mark.parametrize("folder", ["tables", "figures"])
def test_a_folder_that_cannot_be_written_is_named(make_run: MakeRun, folder: str) -> None:
    run = make_run(n=1)
    (run.path / folder).write_text("")
    with pytest.raises(StoreError, match=f"cannot write .*{folder}"):
        write_shown(run, EXPERIMENT.show(run))


@pytest.mark.parametrize(("count", "width"), [(1, 120), (2, 80), (6, 60)])
def test_the_terminal_shows_the_stages_what_they_say_and_where_the_rest_is(
    make_run: MakeRun, plausible: dict[str, Any], black_box: Any, count: int, width: int
) -> None:
    cells = dict(list((plausible | {"http/llama-server": black_box}).items())[:count])
    run = make_run(cells, n=8)
    text = printed(run, width)
    assert "…" not in text
    shown, _, rest = text.partition("more tables (summary, summary-e2e")
    assert all(len(line.rstrip()) <= width for line in shown.splitlines())
    rows = (group_table(cells_of(run)) if count > 2 else stage_table(cells_of(run))).rows
    assert {word for row in rows for word in row[-1].split()} <= {*shown.split()}
    assert "Echo engine." in " ".join(shown.split())
    assert ("mean ± sd" in shown) is (count < 3)
    assert "--verbose prints them" in rest


def test_an_empty_run_prints_a_line(make_run: MakeRun) -> None:
    assert "No samples." in printed(make_run({}))


def test_over_launches_the_table_says_by_how_much_they_differ(
    make_run: MakeRun, make_row: Callable[..., SampleRow]
) -> None:
    rows = []
    for launch, factor in enumerate((1.0, 1.1, 0.9)):
        for cell, durations in HAND.items():
            slow = {stage: ms * (factor if cell.startswith("http") else 1) for stage, ms in durations.items()}
            rows += [make_row(cell, slow, 10 * launch + block, launch=launch) for block in range(3)]
    table = summary_table(cells_of(make_run({}, extra=tuple(rows))))
    assert "Ratios are over 3 launches" in table.notes[-1]
    assert "10 %" in table.notes[-1]
