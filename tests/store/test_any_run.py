"""Whatever came from outside: a run folder that was written can be read, and reported on."""

from __future__ import annotations

import json
import tempfile
from operator import itemgetter
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import RunWriter, read_run
from tests.cli.program import called
from tests.conftest import examples
from tests.made_runs import BLACK_BOX, marks_of, row_of

TEXTS = st.text(st.characters(exclude_categories=()), max_size=20) | st.sampled_from(
    ["\x00", '"', '"\n', "\r", "\r\n", ",,", "=1+1", "\ud800", "\x1b[2J", "NaN", "null", "\u202e", "$x_$", "<b>", "$"]
)
WHOLE = st.integers() | st.sampled_from([2**63, -(2**63) - 1, 10**25, 10**5000])
NUMBERS = WHOLE | st.floats() | st.sampled_from([1e25, 1e300])
MARKS = st.lists(
    st.tuples(st.sampled_from(["", "capture", "server", "return"]), st.integers(-(2**70), 2**70)), max_size=5
).map(lambda marks: sorted(marks, key=itemgetter(1)))
"""In order of time, as `Trace.chain` has them."""
SAMPLES = st.fixed_dictionaries(
    {},
    optional={
        "error": TEXTS,
        "request_id": TEXTS,
        "marks": MARKS,
        "n_tokens": WHOLE,
        "last_token_ns": WHOLE,
        "frame_age_ns": WHOLE,
        "cache_n": WHOLE,
        "prompt_n": WHOLE,
        "server_prompt_ms": NUMBERS,
        "rgb_engine": WHOLE,
        "facts": st.dictionaries(TEXTS, NUMBERS, max_size=4),
    },
)
TOKENS = st.lists(st.tuples(WHOLE, TEXTS), max_size=3)


def write(root: Path, samples: list[dict[str, Any]], tokens: list[tuple[int, str]], note: str) -> RunWriter:
    """Write a run in which some samples are as any other, and some as given; it stays open."""
    run = RunWriter.create(root, "latency", {"note": note, "asked": {note: {"url": note}}})
    run.update(flags={note: {"dialect": note}, f"another {note}": {}})
    for block in range(3):
        run.sample(row_of("http/as-deployed", BLACK_BOX, block, marks=marks_of(BLACK_BOX, 10**9), n_tokens=1))
    for block, facts in enumerate(samples, 3):
        sample: SampleRow = row_of("http/as-deployed", BLACK_BOX, block, **facts)
        run.sample(sample)
    run.tokens(
        TokenRow("r", "http/as-deployed", n, token_id, text, None, n) for n, (token_id, text) in enumerate(tokens)
    )
    return run


def as_kept(text: str) -> str:
    """Half a surrogate pair is kept as its escape."""
    return text.encode("utf-8", "backslashreplace").decode()


@given(st.lists(SAMPLES, max_size=3), TOKENS, TEXTS)
@settings(max_examples=examples(150), suppress_health_check=[HealthCheck.too_slow])
@example([{"facts": {"prompt_n": 10**25}, "prompt_n": 10**25}], [(10**25, "\x00")], "\udcff")
@example([{"marks": [("", -(2**63)), ("server", 2**63 - 1)]}], [], "")
def test_it_can_be_read_while_it_runs_and_when_it_is_done(
    samples: list[dict[str, Any]], tokens: list[tuple[int, str]], note: str
) -> None:
    with tempfile.TemporaryDirectory() as root:
        with write(Path(root), samples, tokens, note) as run:
            running = read_run(run.path)
            errors = [as_kept(facts.get("error", "")) for facts in samples]
            assert running.samples.error[3:].tolist() == errors
        done = read_run(run.path)
        assert done.manifest["note"] == as_kept(note)
        assert done.samples.equals(running.samples)
        assert done.tokens.text.tolist() == running.tokens.text.tolist() == [as_kept(text) for _, text in tokens]
        for text in done.samples.facts:
            json.loads(text)


@given(st.lists(SAMPLES, min_size=1, max_size=3), TOKENS, TEXTS)
@settings(max_examples=examples(5))
@example([{"facts": {"a": 10**25}, "prompt_n": 10**25, "error": "\x1b[2J\r$x_$<b>"}, {}], [(1, "$\\q$")], "\udcff$x_$")
@example([{"marks": [("", -(2**63)), ("server", 2**63 - 1)], "server_prompt_ms": 1e300}], [], "")
def test_it_can_be_reported_on(samples: list[dict[str, Any]], tokens: list[tuple[int, str]], note: str) -> None:
    with tempfile.TemporaryDirectory() as root:
        with write(Path(root), samples, tokens, note) as run:
            pass
        files = {"output": "page.html", "csv": "csv", "latex": "latex", "markdown": "all.md"}
        done = called("report", run.path, *(f"--{flag}={root}/{name}" for flag, name in files.items()))
        assert "left out" not in done.stderr + done.stdout
