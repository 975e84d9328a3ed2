"""The kind of answers and the observation of a request, the same for all cells of a run."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.throughput.config import ThroughputConfig
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.pixels import fingerprint, together
from s2a_bench.harness.plan import answered, resolve
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.trace import Trace
from s2a_bench.transport import ACTIONS, TOKENS, TRANSPORTS
from s2a_bench.transport.http import HTTP
from s2a_bench.types import Action, Request
from s2a_bench.vectors import actions_of, state_of


@pytest.fixture
def actions_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let HTTP carry nothing but actions, as policy servers' wires do."""
    able = type(HTTP).capabilities
    monkeypatch.setattr(type(HTTP), "capabilities", lambda *choice: replace(able(*choice), answer_kinds=(ACTIONS,)))


def config(transports: str = "http,loopback", **more: Any) -> LatencyConfig:
    engine = {"name": more.pop("engine"), **more.pop("settings", {})} if "engine" in more else more.pop("settings", {})
    return LatencyConfig(transports=transports, engine=engine, **more)


def test_all_cells_answer_with_tokens_unless_told() -> None:
    assert config(engine="echo").answer == TOKENS
    assert config(engine="echo", settings={"answer": "actions"}).answer == ACTIONS
    acting = resolve(config(engine="echo", settings={"answer": "actions", "horizon": 9}), print)
    assert acting.request.max_pieces == 9
    assert resolve(config(engine="echo", max_tokens=5), print).request.max_pieces == 5


@pytest.mark.usefixtures("actions_alone")
def test_one_that_carries_nothing_else_decides_for_all() -> None:
    chosen = config(engine="echo")
    assert chosen.answer == ACTIONS
    assert resolve(chosen, print).engine.answer == ACTIONS
    assert chosen.to_manifest()["engine"]["answer"] == ACTIONS
    assert config("loopback", engine="echo").answer == TOKENS
    with pytest.raises(UsageError, match=r"^`answer`: http/as-deployed does not carry tokens; measure it in a run"):
        config(engine="echo", settings={"answer": "tokens"})


@pytest.mark.usefixtures("actions_alone")
def test_an_engine_of_tokens_is_refused_in_one_line() -> None:
    with pytest.raises(UsageError, match=r"^`engine` llama answers with tokens, and http/as-deployed carries actions"):
        config(engine="llama")
    lines: list[str] = []
    assert answered(config(), lines.append).engine.name == "echo"
    assert lines == ["the echo engine answers with actions; a model's are those of its own server, see `url`"]


@pytest.mark.usefixtures("actions_alone")
def test_two_that_have_nothing_in_common_are_not_compared() -> None:
    with pytest.raises(
        UsageError, match=r"^`answer`: ros/action does not carry actions, and http/as-deployed nothing else; measure"
    ):
        config("http,ros/action", engine="echo")


def test_llama_has_no_actions() -> None:
    with pytest.raises(UsageError, match=r"^`answer`: `engine` llama answers with tokens alone; use `engine` echo or"):
        EngineConfig(name="llama", answer="actions")


def test_throughput_counts_tokens() -> None:
    with pytest.raises(UsageError, match=r"^this command counts tokens, and `answer` actions brings actions; 's2a-"):
        ThroughputConfig(engine={"name": "replay", "profile": "jetson-agx-orin", "answer": "actions"})


@pytest.mark.parametrize("name", ["echo", "replay"])
def test_a_chunk_is_as_long_as_told(name: str) -> None:
    profile = {"profile": "rtx-4080", "gaps": "constant"} if name == "replay" else {}
    engine = open_engine(EngineConfig(name=name, answer="actions", horizon=5, action_dim=3, **profile))
    pieces = list(engine.generate(Request("a", "go", max_tokens=64)))
    assert [(type(piece), piece.index, piece.values.shape) for piece in pieces if isinstance(piece, Action)] == [
        (Action, index, (3,)) for index in range(5)
    ]
    assert len(list(engine.generate(Request("a", "go", max_tokens=2)))) == 2
    assert engine.describe()["answer"] == "5 actions of 3"
    again = list(engine.generate(Request("a", "go", max_tokens=64)))
    assert [piece.text for piece in again] == [piece.text for piece in pieces]


def test_the_text_of_an_action_reads_back_to_the_same_bits() -> None:
    values = np.random.default_rng(0).normal(size=50).astype(np.float32)
    text = Action(0, values).text
    assert np.array(json.loads(text), np.float32).tobytes() == values.tobytes()
    assert len(text) < 50 * 14


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([[1.0, float("nan")]], "actions: not finite numbers"),
        ([[1e39]], "actions: not finite numbers"),
        ([["a"]], "actions: shape .* and type <U1, not numbers"),
        ([], r"actions: shape \(0,\)"),
        ([[]], "actions: shape"),
        ([[[1.0]], [[1.0]]], "actions: shape"),
        ([[1.0], [1.0, 2.0]], "actions: not an array of numbers"),
        ([[True]], "actions: shape .* and type bool"),
        (np.zeros((1 << 11, 1 << 10)), "actions: 2097152 numbers; at most"),
        (np.array([object()]), "actions: shape .* and type object"),
    ],
)
def test_what_is_no_chunk_moves_no_robot(values: Any, why: str) -> None:
    with pytest.raises(RequestFailed, match=why):
        actions_of(values)


@pytest.mark.parametrize("values", [[[1.0]], 3, "ab", [float("inf")], [None], {"a": 1}])
def test_what_is_no_state_is_refused(values: Any) -> None:
    with pytest.raises(RequestFailed, match="the state"):
        state_of(values)
    assert state_of([]) == ()
    assert state_of([0.5, 1]) == (0.5, 1.0)


def test_a_request_brings_several_pictures_scaled_and_the_state() -> None:
    observed = config("http,ros/topic", engine="echo", cameras=3, resize="224", state=14)
    assert observed.resize == (224, 224)
    assert observed.to_manifest()["observation"] == "3 x 640x480 as 224x224, state of 14"
    assert config(engine="echo", resize="320x240").resize == (320, 240)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"mode": "stream", "cameras": 2}, "^`cameras`: in `mode` stream one camera runs"),
        ({"mode": "stream", "resize": "224"}, "^`resize`: in `mode` stream one camera runs"),
        ({"transports": "ros/topic?payload=yuyv", "resize": "224"}, "^`resize`: yuyv is what the camera gave; use"),
        ({"transports": "ros/action", "state": 3}, "^`state`: a request of ros/action has no place for it"),
        ({"transports": "http?url=http://localhost:9", "state": 3}, "^`state`: a request of http/as-deployed"),
        ({"resize": "0"}, "^`resize`: 0x0 should be 1x1 to"),
        ({"resize": "big"}, "^`resize`: 'big' should look like 640x480"),
        ({"cameras": 0}, "^`cameras`: 0 should be greater than or equal to 1"),
    ],
)
def test_what_cannot_be_carried_is_refused(more: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        config(engine="echo", **more)


def test_frames_are_read_and_scaled_one_after_the_other() -> None:
    from s2a_bench.frames import open_source

    feed = RequestFeed(open_source("synthetic", 64, 48), preencoded=False, cameras=2, size=(32, 32))
    trace = Trace()
    frames = feed.capture(trace)
    assert [(frame.index, frame.encoding, frame.data.shape) for frame in frames] == [
        (0, "bgr8", (32, 32, 3)),
        (1, "bgr8", (32, 32, 3)),
    ]
    assert [stage for stage, _ in trace.marks] == ["", "capture", "convert", "resize", "convert", "resize"]


def test_a_checksum_of_several_knows_their_order() -> None:
    assert together([7]) == 7
    assert together([7, 8]) != together([8, 7])
    assert 0 <= together([2**52 - 1] * 9) < 2**52
    from s2a_bench.frames import open_source

    source = open_source("synthetic", 64, 48)
    frame = source.read()
    assert together([fingerprint(frame.data)]) == fingerprint(frame.data)
    assert TRANSPORTS["loopback"].answer_kinds == (TOKENS, ACTIONS)
