"""What a session derives from the marks of a request."""

from __future__ import annotations

import pytest

from s2a_bench.harness.session import inference_start_ns
from s2a_bench.trace import Trace


@pytest.mark.parametrize("inside", [["inference"], ["preprocess", "inference"]])
def test_inference_starts_where_the_engine_gets_the_request(inside: list[str]) -> None:
    trace = Trace()
    trace.marks = [(stage, 10 * place) for place, stage in enumerate(["", "capture", "queue", *inside, "return"])]
    assert inference_start_ns(trace) == 20
