import json
import re
from collections.abc import Callable
from typing import Any

import jsonschema

from s2a_bench.experiments.latency import EXPERIMENT
from s2a_bench.experiments.latency.metrics import latency_json
from s2a_bench.experiments.requests import cells_of
from s2a_bench.store.requests import SampleRow
from s2a_bench.trace import GROUPS, path_of
from s2a_bench.transport import TRANSPORTS
from tests.made_runs import SCHEMA, MakeRun

WARNING = {"code": "cpu-governor", "message": "the governor is powersave", "advice": "set it to performance"}


def validate(whole: object) -> None:
    jsonschema.validate(whole, SCHEMA, cls=jsonschema.Draft202012Validator)


def test_the_schema_is_a_schema_and_knows_every_stage_and_group() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    cell = SCHEMA["$defs"]["latency_cell"]["properties"]
    stages = [*path_of(transport.stages for _, transport in TRANSPORTS.loaded()), "residual"]
    assert all(re.search(cell["stages_ms"]["propertyNames"]["pattern"], stage) for stage in stages)
    assert cell["groups_ms"]["propertyNames"]["enum"] == list(GROUPS)


def test_real_output_is_strict_json_and_valid(make_run: MakeRun, plausible: Any, black_box: Any) -> None:
    cells = plausible | {"http/black-box": black_box}
    run = make_run(cells, n=5, manifest={"warnings": [WARNING], "environment": {"cpu": "EPYC"}}, frame_age_ns=5_000_000)
    whole = json.loads(json.dumps(latency_json(cells_of(run)), allow_nan=False))
    validate(whole)
    assert whole["schema"] == "s2a-bench/1"
    assert whole["command"] == "latency"
    assert whole["run"] == str(run.path)
    assert whole["environment"] == {"cpu": "EPYC"}
    assert whole["warnings"] == [WARNING]
    assert len(whole["cells"]) == 6
    # 3 HTTP over ROS, 4 over loopback; and for e2e the black box over both besides
    assert len(whole["ratios"]) == 7 + 9
    (cell,) = (cell for cell in whole["cells"] if cell["cell"] == "http/black-box")
    assert cell["stages_ms"]["server"]["n"] == cell["e2e_ms"]["n"] == 5
    assert not {"e2e_without_inference_ms", "residual_share"} & set(cell)
    assert "inference" not in cell["stages_ms"]


def test_one_cell_by_hand(make_run: MakeRun) -> None:
    stages = {"capture": 1, "cdr_pack": 2, "": 0.25, "network": 3, "inference": 100, "return": 1.75}
    (cell,) = latency_json(
        cells_of(make_run({"ros/topic": stages}, n=4, spread=0, n_tokens=2, frame_age_ns=7_000_000))
    )["cells"]

    def exactly(value: float, n: int = 4) -> dict[str, float]:
        return {"n": n, "median": value, "mean": value, "sd": 0.0, "p90": value, "p99": value}

    assert cell == {
        "cell": "ros/topic",
        "pipeline": "ros",
        "variant": "topic",
        "payload": "raw",
        "observation": "640x480",
        "answer": "tokens",
        "connection": "keep-alive",
        "engine": "echo",
        "mode": "request",
        "size": "640x480",
        "profile": None,
        "emulated": False,
        "n": 4,
        "errors": 0,
        "warmups": 5,
        "residual_flagged": 0,
        "stages_ms": {stage: exactly(ms) for stage, ms in stages.items() if stage},
        "groups_ms": {stage.removeprefix("cdr_"): exactly(ms) for stage, ms in stages.items() if stage},
        "e2e_ms": exactly(108),
        "e2e_without_inference_ms": exactly(8),
        "ttft_ms": exactly(107),
        "frame_age_ms": exactly(7),
        "itl_ms": exactly(2),
        "residual_ms": exactly(0.25),
        "residual_share": exactly(0.03125),
    }


def test_a_ratio_carries_its_interval(make_run: MakeRun) -> None:
    whole = latency_json(cells_of(make_run(n=30, manifest={"seeds": {"bootstrap": 4}})))
    ratio = whole["ratios"][0]
    assert (ratio["metric"], ratio["of"], ratio["to"]) == ("e2e_without_inference_ms", "http/as-deployed", "ros/topic")
    low, high = ratio["ci95"]
    assert low < ratio["value"] < high
    assert low < 7.33 / 1.37 < high


def test_a_cell_in_which_everything_failed_is_still_a_cell(
    make_run: MakeRun, make_row: Callable[..., SampleRow]
) -> None:
    extra = tuple(make_row("ros/topic", {"capture": 1}, block, error="lost") for block in range(3))
    whole = latency_json(cells_of(make_run({}, extra=extra)))
    validate(whole)
    (cell,) = whole["cells"]
    assert (cell["n"], cell["errors"], cell["stages_ms"]) == (0, 3, {})
    assert "e2e_ms" not in cell


def test_a_run_without_samples_is_valid_and_has_no_figures(make_run: MakeRun) -> None:
    run = make_run({})
    whole = latency_json(cells_of(run))
    validate(whole)
    assert whole["cells"] == whole["ratios"] == []
    assert EXPERIMENT.show(run).figures == {}
