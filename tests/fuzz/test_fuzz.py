"""Whatever readers are given, they read it or say in one line why not.

The short form, of every test run, draws the same damage each time. ``make fuzz`` draws new damage for ten minutes
(``S2A_FUZZ_S``); what it finds is kept by hypothesis and tried first the next time, and belongs into ``corpus/``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from s2a_bench.errors import S2AError
from tests.conftest import examples
from tests.fuzz.targets import TARGETS, Target

CORPUS = Path(__file__).parent / "corpus"
SECONDS = float(os.environ.get("S2A_FUZZ_S", "0"))
EXAMPLES = examples(60)
ODD = [
    *(b"\xff", b"\0", b"\n", b'"', b"{", b"[" * 2000, b"\xed\xa0\x80", b"-1", b"1e999", b"NaN", b"9" * 400, b"=", b";"),
    *(b"\xff\xff\xff\xff", b"\xff" * 8, b"\0" * 8, b"\x1b[2J", b"\\ud800", b"null", b"&", b"*", b"<<", b"%00", b"?"),
]
VALUES = st.sampled_from(
    [None, True, -1, 5, 2**70, 1.5, 1e300, float("nan"), "", "a\x1b", "\ud800", [], [[]], [5], {}, {"a": {}}, [None]]
)


@st.composite
def damaged(draw: st.DrawFn, target: Target, seeds: list[bytes]) -> bytes:
    """Draw a seed with a value replaced or gone, bytes changed, put in or repeated, or its end cut off."""
    data = draw(st.sampled_from(seeds))
    if target.json and draw(st.booleans()):
        data = changed(draw, data)
    for _ in range(draw(st.integers(0, 3))):
        at, end = sorted((draw(st.integers(0, len(data))), draw(st.integers(0, len(data)))))
        match draw(st.sampled_from(["put", "replace", "flip", "repeat", "cut"])):
            case "put":
                data = data[:at] + draw(st.sampled_from(ODD)) + data[at:]
            case "replace":
                odd = draw(st.sampled_from(ODD))
                data = data[:at] + odd + data[at + len(odd) :]
            case "flip":
                data = data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
            case "repeat":
                data = data[:at] + data[at : min(end, at + 200)] * draw(st.integers(0, 3)) + data[end:]
            case _:
                data = data[:at]
    return data


def changed(draw: st.DrawFn, data: bytes) -> bytes:
    """Replace or drop one value of a JSON text, if it is one."""
    try:
        whole = json.loads(data)
    except ValueError:
        return data
    at: Any = whole
    while isinstance(at, (dict, list)) and at:
        key = draw(st.sampled_from(list(at) if isinstance(at, dict) else list(range(len(at)))))
        if isinstance(at[key], (dict, list)) and at[key] and draw(st.integers(0, 3)):
            at = at[key]
            continue
        if draw(st.booleans()):
            at[key] = draw(VALUES)
        else:
            del at[key]
        break
    return json.dumps(whole).encode()


def try_one(target: Target, data: bytes) -> None:
    try:
        target.read(data)
    except S2AError as error:
        said = str(error)
    else:
        return
    assert len(said.splitlines()) == 1, said


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_read_and_so_is_what_was_found_before(name: str) -> None:
    for seed in TARGETS[name].seeds():
        try_one(TARGETS[name], seed)
    for path in sorted((CORPUS / name).glob("*")):
        try_one(TARGETS[name], path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_damage_is_read_or_told_in_one_line(name: str) -> None:
    target = TARGETS[name]
    seeds = target.seeds()

    @settings(
        max_examples=200 if SECONDS else EXAMPLES,
        derandomize=not SECONDS,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=damaged(target, seeds))
    def try_many(data: bytes) -> None:
        try_one(target, data)

    until = monotonic() + SECONDS / len(TARGETS)
    try_many()
    while monotonic() < until:
        try_many()
