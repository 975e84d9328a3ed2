"""Profiles: what ships is the paper's, what is wrong is named, what is written reads back."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.boards.gaps import Lognormal
from s2a_bench.boards.profile import (
    SHIPPED,
    find_profile,
    load_profile,
    parse_profile,
    profile_files,
    read_profile,
    to_toml,
)
from s2a_bench.errors import UsageError
from s2a_bench.plugins import paper
from s2a_bench.sweep.file import sweep_files

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

GOOD: dict[str, Any] = {
    "title": "A board",
    "origin": "measured",
    "tokens_per_s": 5.0,
    "prompt_s": 0.3,
    "gaps": {"family": "lognormal", "cv": 0.1},
}
TRACE: dict[str, Any] = {"warmups": 1, "ttft_ns": [9, 8, 7], "gaps_ns": [[10**9], [10**8, 3 * 10**8], [2 * 10**8]]}


def parse(**changes: Any) -> Any:
    document = {key: value for key, value in (GOOD | changes).items() if value is not None}
    return parse_profile("board", to_toml(document), "profile board.toml")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder with an empty folder of settings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


def put(folder: Path, name: str, **changes: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(to_toml(GOOD | changes))
    return path


def test_a_sweep_of_the_user_counts_instead_of_a_shipped_one_of_its_name(elsewhere: Path) -> None:
    name = next(iter(sweep_files()))
    own = elsewhere / "config/s2a-bench/profiles/sweeps" / f"{name}.toml"
    own.parent.mkdir(parents=True)
    own.touch()
    assert sweep_files()[name] == own


@pytest.mark.usefixtures("elsewhere")
def test_what_ships_has_the_papers_rates_and_says_what_is_assumed() -> None:
    shipped = {profile.name: profile for profile in map(read_profile, profile_files().values())}
    assert set(shipped) == {"rtx-4080", "jetson-agx-orin", "jetson-orin-nano"}
    rates = tomllib.loads((Path(paper.__file__).parent / "paper_reference.toml").read_text())["throughput"]
    prompt_s = {"rtx-4080": 0.05, "jetson-agx-orin": 0.5, "jetson-orin-nano": 3.0}
    for name, profile in shipped.items():
        assert profile.tokens_per_s == rates[name.replace("-", "_")]
        assert profile.origin == "paper"
        assert profile.prompt_s == prompt_s[name]
        assert (profile.prompt_cv, profile.rate_cv) == (0.15, 0.1)
        assert profile.gaps == Lognormal(1 / profile.tokens_per_s, 0.2)
        assert set(profile.assumed) == {"prompt_s", "prompt_cv", "rate_cv", "gaps"}
        assert profile.trace_s == ()
        assert profile.facts["board"]


def test_a_recording_is_flattened_without_its_warm_ups() -> None:
    profile = parse(trace=TRACE)
    assert profile.trace_s == (0.1, 0.3, 0.2)
    assert profile.tokens_per_s == 5.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"titel": "x"}, r"titel: there is no such key; did you mean title\?$"),
        ({"title": None}, "title: is missing"),
        ({"title": " "}, "title: should be a text of one line"),
        ({"origin": "guessed"}, "origin: 'guessed' should be 'paper' or 'measured'"),
        ({"tokens_per_s": None}, "tokens_per_s: is missing"),
        ({"tokens_per_s": "fast"}, "tokens_per_s: 'fast' should be a number"),
        ({"tokens_per_s": True}, "tokens_per_s: True should be a number"),
        ({"tokens_per_s": 0}, "tokens_per_s: 0 should be greater than 0"),
        ({"tokens_per_s": 10**400}, "tokens_per_s: 1000.* should be a number"),
        ({"tokens_per_s": 5e-324}, "gaps.mean_s: inf should be a finite number"),
        ({"prompt_s": float("nan")}, "prompt_s: nan should be a finite number"),
        ({"prompt_s": -0.1}, "prompt_s: -0.1 should be greater than or equal to 0"),
        ({"prompt_cv": []}, r"prompt_cv: \[\] should be a number"),
        ({"rate_cv": float("inf")}, "rate_cv: inf should be a finite number"),
        ({"assumed": "prompt_s"}, "assumed: 'prompt_s' should be a list"),
        ({"assumed": ["prompt"]}, r"assumed\[0\]: 'prompt' should be 'tokens_per_s', 'prompt_s'"),
        ({"assumed": [["prompt_s"]]}, r"assumed\[0\]: \['prompt_s'\] should be 'tokens_per_s'"),
        ({"gaps": None}, "gaps: is missing"),
        ({"gaps": 0.2}, "gaps: 0.2 should be a table"),
        ({"gaps": {"family": "lognormal"}}, "gaps.cv: is missing"),
        ({"board": "Orin"}, "board: 'Orin' should be a table"),
        ({"capture": {"room": {"degrees": [20.5, float("nan")]}}}, "capture.room.degrees: nan should be finite"),
        ({"trace": [1, 2]}, r"trace: \[1, 2\] should be a table"),
        ({"trace": TRACE | {"gaps": []}}, r"trace.gaps: there is no such key; did you mean gaps_ns\?"),
        ({"trace": TRACE | {"gaps_ns": [1, 2]}}, r"trace.gaps_ns\[0\]: 1 should be a list"),
        ({"trace": TRACE | {"gaps_ns": [[1.5], [2], [3]]}}, r"trace.gaps_ns\[0\]\[0\]: 1.5 should be a whole number"),
        ({"trace": TRACE | {"gaps_ns": [[-1], [2], [3]]}}, r"trace.gaps_ns\[0\]\[0\]: -1 should be greater than"),
        ({"trace": TRACE | {"ttft_ns": [1]}}, "trace.ttft_ns: should hold a whole number of ns for each of the 3"),
        ({"trace": TRACE | {"warmups": 3}}, "trace.warmups: 3 of 3 requests leave no gaps"),
        ({"trace": {}}, "trace.gaps_ns: is missing"),
        ({"trace": TRACE, "tokens_per_s": 5.2}, r"tokens_per_s: 5.2, but the gaps of \[trace\] make 5;"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_file_and_key(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=f"^profile board.toml: {message}") as caught:
        parse(**changes)
    assert "\n" not in str(caught.value)


def test_what_is_no_toml_and_what_cannot_be_read_say_so(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    with pytest.raises(UsageError, match=r"`profile`: cannot read .*x\.toml: "):
        read_profile(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match=r"`profile`: cannot read .*x\.toml: "):
        read_profile(path)
    path.write_text("title = ")
    with pytest.raises(UsageError, match=r"profile .*x\.toml: not TOML"):
        read_profile(path)


def test_the_first_folder_that_has_a_name_wins(elsewhere: Path) -> None:
    assert find_profile("rtx-4080").parent == SHIPPED
    user = put(elsewhere / "config" / "s2a-bench" / "profiles", "rtx-4080", title="The user's")
    assert find_profile("rtx-4080") == user
    put(elsewhere / "profiles", "rtx-4080", title="This folder's")
    assert load_profile("rtx-4080").title == "This folder's"
    put(elsewhere / "profiles", "another")
    assert list(profile_files()) == ["another", "jetson-agx-orin", "jetson-orin-nano", "rtx-4080"]


def test_a_path_is_a_path_wherever_it_is(elsewhere: Path) -> None:
    path = put(elsewhere / "deep", "mine")
    assert load_profile(str(path)).name == "mine"
    assert load_profile("deep/mine.toml").name == "mine"
    with pytest.raises(UsageError, match=r"`profile`: there is no file deep/other\.toml"):
        load_profile("deep/other.toml")
    with pytest.raises(UsageError, match="`profile`: there is no file deep/mine"):
        load_profile("deep/mine")


SCALARS = st.one_of(
    st.text(st.characters(exclude_categories=("Cs",))),
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=30,
)


@given(st.dictionaries(st.text(st.characters(exclude_categories=("Cs",)), max_size=9), VALUES, max_size=6))
def test_what_is_written_as_toml_reads_back(document: dict[str, Any]) -> None:
    try:
        "".join(str(document)).encode()
    except UnicodeEncodeError:
        return
    assert tomllib.loads(to_toml(document)) == document


def test_unknown_facts_are_left_out_of_a_file() -> None:
    assert tomllib.loads(to_toml({"a": None, "b": {"c": None, "d": 1}})) == {"b": {"d": 1}}
