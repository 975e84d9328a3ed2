"""Marks, stages and the closed budget."""

from __future__ import annotations

import math
import timeit
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.clock import clock_id, now_ns
from s2a_bench.trace import RESIDUAL, RESIDUAL_LIMIT, STAGES, Remote, Trace, budget, mark_cost_ns, path_of

names = st.sampled_from([RESIDUAL, *STAGES])
chains = st.lists(st.tuples(names, st.integers(0, 10**9)), max_size=40).map(
    lambda steps: [(name, sum(step for _, step in steps[: place + 1])) for place, (name, _) in enumerate(steps)]
)


@given(chains)
def test_stages_and_residual_sum_to_the_whole(chain: list[tuple[str, int]]) -> None:
    spent = budget(chain)
    assert sum(spent.stages_ns.values()) + spent.residual_ns == spent.e2e_ns
    assert spent.e2e_ns == (chain[-1][1] - chain[0][1] if chain else 0)


def test_a_chain_by_hand() -> None:
    chain = [
        ("", 100),
        ("capture", 110),
        ("convert", 140),
        ("", 145),
        ("network", 200),
        ("inference", 900),
        ("return", 950),
    ]
    spent = budget(chain)
    assert spent.stages_ns == {"capture": 10, "convert": 30, "network": 55, "inference": 700, "return": 50}
    assert spent.residual_ns == 5
    assert spent.e2e_ns == 850
    assert spent.e2e_without_inference_ns == 150
    assert spent.residual_share == pytest.approx(5 / 150)
    assert spent.residual_share < RESIDUAL_LIMIT == 0.05


def test_preprocessing_is_inference_and_not_the_model() -> None:
    chain = [("", 100), ("capture", 110), ("network", 200), ("preprocess", 250), ("inference", 900), ("return", 950)]
    spent = budget(chain)
    assert spent.e2e_without_inference_ns == 150
    assert spent.e2e_without_model_ns == 200


def test_where_preprocessing_is_not_told_the_model_is_not_either() -> None:
    assert budget([("", 0), ("inference", 7), ("return", 9)]).e2e_without_model_ns is None


def test_a_stage_marked_twice_is_the_sum() -> None:
    assert budget([("", 0), ("image_decode", 5), ("", 6), ("image_decode", 9)]).stages_ns == {"image_decode": 8}


def test_without_inference_there_is_no_e2e_without_it() -> None:
    spent = budget([("", 0), ("server", 7)])
    assert spent.e2e_without_inference_ns is None
    assert spent.residual_share is None


def test_own_stages_come_last_on_the_way_out_and_first_on_the_way_in() -> None:
    own = [{"wrap": "encode", "json": "pack"}, {"accept": "network", "unwrap": "decode", "teleport": "network"}]
    assert [*path_of(own)] == [
        *("capture", "convert", "resize", "image_encode", "wrap", "json", "connect", "network", "accept", "teleport"),
        *("unwrap", "image_decode", "yuv_decode", "channel_swap", "queue"),
        *("preprocess", "inference", "server", "return"),
    ]
    assert path_of([]) == STAGES


def test_both_sides_join_in_order_of_time() -> None:
    trace = Trace()
    trace.marks = [("", 10), ("json_pack", 20), ("return", 90)]
    came = "".join([*clock_id()])  # as over a wire: equal, and not the same object
    trace.receive(Remote(came, [("network", 40), ("inference", 80)], facts={"prompt_n": 3.0}))
    assert [name for name, _ in trace.chain()] == ["", "json_pack", "network", "inference", "return"]
    assert trace.facts == {"prompt_n": 3.0}


def test_marks_of_another_clock_are_not_mixed_in_unless_shifted() -> None:
    trace = Trace()
    trace.marks = [("", 10), ("return", 90)]
    trace.receive(Remote("another host", [("network", 40)]))
    assert trace.chain() == [("", 10), ("server", 90)]
    trace.receive(Remote("another host", [("network", 1040)], [1060], frame_marks=[("network", 1005)]).shifted(1000))
    assert trace.chain() == [("", 10), ("network", 40), ("return", 90)]
    assert (trace.remote.token_ns, trace.remote.frame_marks) == ([60], [("network", 5)])


def test_what_a_server_says_of_itself_is_a_number_that_floats_count_exactly_or_odd() -> None:
    trace = Trace()
    trace.learn({"most": 2**53, "least": -(2**53), "half": 0.5, "n" * 63: 1})
    assert (trace.facts, trace.odd) == ({"most": 2**53, "least": -(2**53), "half": 0.5, "n" * 63: 1}, set())
    trace.learn({"more": 2**53 + 1, "less": -(2**53) - 1, "nan": math.nan, "inf": math.inf, "yes": True, "text": "1"})
    assert trace.odd == {"more", "less", "nan", "inf", "yes", "text"}
    trace.learn({"n" * 64: 1, "a b": 1, 5: 1})  # type: ignore[dict-item]
    assert trace.odd == {"more", "less", "nan", "inf", "yes", "text", "an invalid name"}
    assert len(trace.facts) == 4


REMOTE = Remote("clock", [("network", 2**62 - 1)], [0], -1, [("queue", 0)], {}, {})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"clock": 5}, "stages are not text"),
        ({"marks": [(5, 1)]}, "stages are not text"),
        ({"frame_marks": [(None, 1)]}, "stages are not text"),
        ({"marks": [("network", 2**62)]}, "times are invalid"),
        ({"frame_marks": [("queue", -1)]}, "times are invalid"),
        ({"token_ns": [1.0]}, "times are invalid"),
        ({"token_ns": [True]}, "times are invalid"),
        ({"frame_stamp_ns": 2**62}, "times are invalid"),
        ({"facts": []}, "facts without names"),
        ({"provenance": "llama"}, "a provenance without names"),
    ],
)
def test_what_can_be_no_server_s_marks_is_refused(wrong: dict[str, Any], message: str) -> None:
    assert REMOTE.check() is REMOTE
    with pytest.raises(ValueError, match=message):
        replace(REMOTE, **wrong).check()


def test_a_mark_costs_a_few_readings_of_the_clock() -> None:
    reading = min(timeit.repeat(now_ns, number=10_000, repeat=5)) / 10_000 * 1e9
    assert 0.2 * reading < min(mark_cost_ns() for _ in range(5)) < 20 * reading
