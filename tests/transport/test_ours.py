"""What our clients and servers add to a policy server's protocol."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.ours import OWN, parameters, remote_message, remote_of, request_of, told_in
from s2a_bench.types import Request

PLAIN = Remote("c", [("queue", 1)], [2]).to_json()


def test_a_request_s_own_fields_come_back_and_leave_the_observation() -> None:
    asked = Request("a", "go", max_tokens=3, seed=7, grammar="root ::= 'x'")
    message = {"prompt": "go", OWN: parameters(asked)}
    assert request_of(message, told_in(message), Trace(), LIMITS) == asked
    assert message == {"prompt": "go"}


def test_marks_come_back() -> None:
    assert remote_of(remote_message(Remote("c", [("queue", 1)], [2]))) == Remote("c", [("queue", 1)], [2])


@pytest.mark.parametrize(
    "message",
    [
        *(None, 5, [], "s2a", {}, np.zeros(3), {OWN: None}, {OWN: np.zeros(3)}),
        *({OWN: {**PLAIN, name: 5}} for name in ("clock", "marks", "token_ns", "facts")),
        {OWN: {**PLAIN, "marks": [("queue", -1)]}},
    ],
    ids=str,
)
def test_marks_that_are_none_are_refused_in_a_line(message: Any) -> None:
    with pytest.raises(RequestFailed, match=r"^what should be the server's marks is none: .") as failed:
        remote_of(message)
    assert str(failed.value).isprintable()


def test_what_is_no_map_is_no_word_of_ours() -> None:
    assert told_in(np.zeros(3)) is None
    with pytest.raises(RequestFailed, match="s2a should be a map"):
        told_in({OWN: [1]})
