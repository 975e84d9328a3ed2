"""A fact is its own name, wherever a name goes."""

from __future__ import annotations

import copy
import json

import orjson

from s2a_bench.facts import PROMPT_N, Fact, facts_json
from s2a_bench.trace import Trace


def test_a_fact_is_a_name_with_unit_and_meaning() -> None:
    fact = Fact("spins", "rad", "how far it turned")
    assert {fact: 1.0}["spins"] == 1.0
    assert json.dumps({fact: 1.0}) == '{"spins": 1.0}'
    assert facts_json([fact]) == {"spins": {"unit": "rad", "about": "how far it turned"}}
    assert copy.deepcopy(fact).unit == "rad"


def test_what_a_server_sends_back_has_plain_names() -> None:
    trace = Trace()
    trace.facts[PROMPT_N] = 3.0
    assert orjson.dumps(trace.to_remote().facts) == b'{"prompt_n":3.0}'
