"""Numbers that servers tell and that can be none: the fact is absent, the run says so once, the sample counts."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import Task, run_requests
from s2a_bench.progress import NullProgress
from s2a_bench.provenance import Provenance
from s2a_bench.store.run import read_run
from s2a_bench.testing.transport import wiring_of
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport import open_client
from s2a_bench.transport.http.detect import cache_hits
from s2a_bench.transport.http.dialects import open_dialect
from s2a_bench.transport.ros.wire import remote_of
from s2a_bench.types import Request
from tests.hostile.wires.http import delta
from tests.servers.sockets import head, serving

NONE = ["NaN", "Infinity", "-Infinity", "1e25", "1e300", "1e999", '"12"', "true", "-1", "[]", "{}", str(10**400)]
TOLD = [
    ("openai", '{"choices": [], "usage": {"prompt_tokens": %s}}', "prompt_n"),
    ("openai", '{"choices": [], "usage": {"prompt_tokens_details": {"cached_tokens": %s}}}', "cache_n"),
    ("openai", '{"choices": [], "timings": {"prompt_ms": %s}}', "prompt_ms"),
    ("vllm", '{"choices": [], "metrics": {"queue_time_ms": %s}}', "queue_ms"),
    ("ollama", '{"done": true, "prompt_eval_count": %s}', "prompt_with_cached_n"),
    ("ollama", '{"done": true, "eval_duration": %s}', "predicted_ms"),
    ("tgi", '{"details": {"generated_tokens": %s}}', "predicted_n"),
    ("gemini", '{"usageMetadata": {"promptTokenCount": %s}}', "prompt_n"),
]


@pytest.mark.parametrize(
    ("dialect", "message", "fact", "value"),
    [*((*TOLD[0], value) for value in NONE), *((*told, "1e25") for told in TOLD[1:])],
)
def test_it_is_absent_and_told(dialect: str, message: str, fact: str, value: str) -> None:
    event, trace = open_dialect(dialect).event(json.loads(message % value)), Trace()
    trace.learn(event.facts)
    assert trace.facts == {}
    assert trace.odd == {fact}


@pytest.mark.parametrize("value", ["NaN", "1e300", '"12"'])
def test_a_rate_that_can_be_none_fails_no_sample(value: str) -> None:
    trace = Trace()
    message = '{"timings": {"predicted_per_second": %s, "predicted_ms": 12}}'
    trace.learn(open_dialect("llama-server").event(json.loads(message % value)).facts)
    assert trace.facts == {"predicted_ms": 12.0}
    assert trace.odd == {"predicted_steps"}


@pytest.mark.parametrize("value", ["NaN", "+Inf", "1e300", "-1", "x"])
def test_a_count_of_hits_that_can_be_none_is_absent(value: str) -> None:
    pieces = [head(kind="text/plain"), f"vllm:prefix_cache_hits_total {value}\n".encode()]
    with serving(lambda _: pieces) as url:
        assert cache_hits(wiring_of("http/as-deployed", url=url)) == {}


def test_more_cached_than_there_was_is_odd() -> None:
    usage = {"prompt_tokens": 3, "prompt_tokens_details": {"cached_tokens": 5}}
    trace = Trace()
    trace.learn(open_dialect("openai").event({"usage": usage}).facts)
    assert trace.facts == {"cache_n": 5.0}
    assert trace.odd == {"prompt_n"}


@pytest.mark.parametrize("value", [1e300, 1.5, -1, "7", None, 2**70, True, [3]])
def test_a_token_s_id_that_can_be_none_is_unknown(value: Any) -> None:
    assert open_dialect("tgi").event({"token": {"id": value, "text": "x"}}).token_id == -1
    choice = {"delta": {"content": "x"}, "token": value}
    assert open_dialect("s2a").event({"choices": [choice]}).token_id == -1


def test_a_run_with_them_counts_and_warns_once_a_field(tmp_path: Path) -> None:
    numbers = b'data: {"choices": [], "usage": {"prompt_tokens": 1e25}, "timings": {"prompt_ms": NaN}}\n\n'
    pieces = [head(), delta(content="x"), numbers, b"data: [DONE]\n\n"]
    with serving(lambda _: pieces) as url:
        http = {"url": url, "dialect": "llama-server"}
        config = RequestsConfig(
            transports="http/as-deployed", options={"http": http}, size="64x48", requests=3, warmup=1
        )
        folder = run_requests(Task("latency"), resolve(config, print), tmp_path, NullProgress())
    run = read_run(folder)
    assert run.samples.error.tolist() == [""] * 4
    assert run.samples.prompt_n.isna().all()
    assert run.samples.server_prompt_ms.isna().all()
    (warning,) = [each for each in run.manifest["warnings"] if each["code"] == "odd-facts"]
    assert "(http/as-deployed: prompt_ms, prompt_n)" in warning["message"]


MARKS = {"clock": "c", "marks": [["", 1]], "token_ns": [2], "frame_stamp_ns": -1, "frame_marks": [], "facts": {}}


@pytest.mark.parametrize(
    "odd",
    [
        {"marks": [["", 1e25]]},
        {"marks": [[7, 1]]},
        {"frame_marks": [["x", None]]},
        {"facts": [1]},
    ],
)
def test_marks_that_can_be_none_fail_their_sample(odd: dict[str, Any]) -> None:
    last = b"data: " + json.dumps({"choices": [], "usage": {}, "s2a": {**MARKS, **odd}}).encode() + b"\n\n"
    pieces = [head(), delta(content="x"), last, b"data: [DONE]\n\n"]
    with serving(lambda _: pieces) as url:
        client = open_client(wiring_of("http/as-deployed", url=url, dialect="s2a"))
        with pytest.raises(RequestFailed, match="this is not the dialect 's2a'"):
            list(client.request(Request("a", "plan"), Trace()))
        client.close()
    assert Remote.of_json(MARKS).token_ns == [2]


def test_facts_of_marks_are_checked_in_name_and_value() -> None:
    trace = Trace()
    trace.receive(Remote("c", facts={"prompt_n": float("nan"), "\x1b[2J": 1.0, "x" * 99: 1.0, "load": 0.5}))
    assert trace.facts == {"load": 0.5}
    assert trace.odd == {"prompt_n", "an invalid name"}


@pytest.mark.parametrize("odd", [{"stamps": [1, 2]}, {"stamps": [-1]}, {"fact_names": ["a"]}])
def test_ros_marks_that_can_be_none_fail_their_sample(odd: dict[str, list[Any]]) -> None:
    plain: dict[str, Any] = {"stages": ["a"], "stamps": [1], "token_stamps": [], "frame_stages": [], "frame_stamps": []}
    lists = {
        **plain,
        "fact_names": [],
        "fact_values": [],
        "provenance": SimpleNamespace(**Provenance().to_dict()),
        **odd,
    }
    arrays = {name: np.array(value) for name, value in lists.items() if "stamps" in name or name == "fact_values"}
    with pytest.raises(RequestFailed, match="the server's marks are malformed"):
        remote_of(SimpleNamespace(**{"clock": "c", "frame_stamp": -1, **lists, **arrays}))
