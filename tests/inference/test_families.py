"""Models of several families: the prompt, and the answer's tokens, are those of llama.cpp's own server."""

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.models import PROMPT, TOKENS, Engine, picture, server
from s2a_bench.errors import ModelError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.dummy import write_dummy, write_mmproj
from s2a_bench.inference.dummy.families import FAMILIES
from s2a_bench.inference.llama_cpp import LlamaCppEngine, llama_cpp
from s2a_bench.testing.engine import ask, rgb_frame
from s2a_bench.types import Frame

ACTIONS = 'root ::= ("stop" | "go") "(" [0-9] ")"'
SURE = 2
"""Tokens of an answer that the kernels of two builds do not part; docs/model.md tells from which on they do here."""


@pytest.fixture(scope="module", params=FAMILIES)
def family(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> EngineConfig:
    model, mmproj = write_dummy(tmp_path_factory.mktemp("dummy"), like=request.param)
    return EngineConfig(model=model, mmproj=mmproj, sampling="greedy", threads=1)


@pytest.fixture(scope="module")
def engine(family: EngineConfig) -> Iterator[LlamaCppEngine]:
    with closing(LlamaCppEngine(family)) as engine:
        yield engine


def strip(seed: int) -> Frame:
    """A third of a picture, of which families that cut pictures make a few slices."""
    whole = picture(seed)
    return replace(whole, height=160, data=whole.data[:160])


@pytest.mark.skipif(find_spec("xllamacpp") is None, reason="the wheel xllamacpp is not installed")
def test_llama_server_is_asked_the_same_and_answers_the_same(
    family: EngineConfig, engine: LlamaCppEngine, tmp_path: Path
) -> None:
    ours = Engine(engine)
    with server(family, tmp_path / "log") as theirs:
        assert theirs.prompt(PROMPT) == ours.prompt(PROMPT)
        for frames in ((strip(1),), (strip(2), strip(3)), ()):
            native, foreign = (side.ask(PROMPT, frames) for side in (ours, theirs))
            assert foreign.prompt_n == native.prompt_n
            assert foreign.ids[:SURE] == native.ids[:SURE]
            assert len(native.ids) == len(foreign.ids) == TOKENS


@pytest.mark.skipif(find_spec("xllamacpp") is None, reason="the wheel xllamacpp is not installed")
@pytest.mark.parametrize("template", ["none", "typed"])
def test_a_real_model_is_asked_the_same_by_llama_server(gemma: Path, tmp_path: Path, template: str) -> None:
    (tmp_path / "typed").write_text(
        "{{ bos_token }}{% for message in messages %}Q: {% for part in message.content %}"
        "{{ part.text }}{% endfor %}{% endfor %}{{ '\\nA:' if add_generation_prompt }}"
    )
    chosen = template if template == "none" else str(tmp_path / "typed")
    config = EngineConfig(model=gemma, chat_template=chosen, sampling="greedy", threads=2)
    with closing(LlamaCppEngine(config)) as engine, server(config, tmp_path / "log") as theirs:
        ours = Engine(engine)
        prompt, tokens = ours.prompt(PROMPT)
        assert theirs.prompt(PROMPT) == (prompt, tokens)
        assert prompt == (PROMPT if template == "none" else f"Q: {PROMPT}\nA:")
        assert tokens.count(2) == 1  # one beginning
        native, foreign = ours.ask(PROMPT, ()), theirs.ask(PROMPT, ())
    assert (foreign.prompt_n, foreign.ids[:SURE]) == (native.prompt_n, native.ids[:SURE])


def logits_of(engine: LlamaCppEngine, frame: Frame) -> NDArray[np.float32]:
    """The logits of the first token of an answer about a picture."""
    ask(engine, images=(frame,), max_tokens=1)
    llama = engine._llama
    return np.ctypeslib.as_array(llama_cpp.llama_get_logits_ith(llama.ctx, -1), (llama.n_vocab(),)).copy()


def test_the_picture_is_seen_and_every_part_of_the_prompt_is_timed(engine: LlamaCppEngine) -> None:
    first, again, other = (logits_of(engine, strip(seed)) for seed in (1, 1, 2))
    facts = engine.facts
    parts = [facts[name] for name in ("preprocess_ms", "vision_encode_ms", "prompt_eval_ms")]
    assert min(parts) > 0
    assert sum(parts) <= facts["prompt_ms"] * 1.001 + 1
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0


def test_a_grammar_is_obeyed_after_a_picture(engine: LlamaCppEngine) -> None:
    tokens = ask(engine, images=(rgb_frame(1, 64, 48),), grammar=ACTIONS, max_tokens=40)
    assert "".join(token.text for token in tokens)[-3:].strip("(0123456789") == ")"


def test_the_batch_changes_no_token(family: EngineConfig, engine: LlamaCppEngine) -> None:
    """Not even one that divides no picture."""
    pictures = (strip(1),)
    with closing(LlamaCppEngine(family.but(batch=100))) as small:
        assert ask(small, images=pictures) == ask(engine, images=pictures)


def test_a_vision_tower_of_another_width_is_a_line(family: EngineConfig, tmp_path: Path) -> None:
    other = tmp_path / "mmproj-other.gguf"
    for like in FAMILIES:
        write_mmproj(other, 512, "tiny", like=like)
        with pytest.raises(ModelError, match=rf"^`mmproj` {other}: llama\.cpp: .*mismatch.*256.*512\)$"):
            LlamaCppEngine(family.but(mmproj=other))


def test_a_real_language_model_answers_about_pictures_with_a_dummy_of_its_tower(gemma: Path, tmp_path: Path) -> None:
    tower = tmp_path / "mmproj.gguf"
    write_mmproj(tower, 640, "tiny", like="gemma3-4b")
    config = EngineConfig(model=gemma, mmproj=tower, chat_template="none", threads=2)
    with closing(LlamaCppEngine(config)) as engine:
        tokens = ask(engine, "The robot says: ", images=(rgb_frame(1, 640, 480),), grammar=ACTIONS, max_tokens=40)
        assert re.fullmatch(r"(stop|go)\(\d\)", "".join(token.text for token in tokens))
        assert engine.facts["prompt_n"] > 256
        assert engine.describe()["dummy"] is True
