import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.errors import ModelError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.tokenizer import Tokenizer


@pytest.fixture(scope="module")
def tokenizer(tiny: EngineConfig) -> Tokenizer:
    return Tokenizer(tiny.model)


def test_the_ids_are_those_of_the_model(tiny: EngineConfig, tokenizer: Tokenizer) -> None:
    engine = LlamaCppEngine(tiny)
    llama = engine._llama
    for text in ("1. go_to(kitchen)\n", " the tea", "\n\n", "küche 鍋", ""):
        assert tokenizer(text) == llama.tokenize(text.encode(), add_bos=False, special=False)
    engine.close()
    assert tokenizer.size == 281
    assert "DUMMY" in tokenizer.name


def test_a_byte_is_a_token_but_for_the_one_merge(tokenizer: Tokenizer) -> None:
    assert len(tokenizer("pick(cup)\n")) == 10
    assert len(tokenizer("the table")) == len("the table") - 1
    assert tokenizer(" t") == tokenizer("a t")[1:]


@given(text=st.text(max_size=60))
def test_the_pieces_make_the_text_again(tokenizer: Tokenizer, text: str) -> None:
    assert b"".join(map(tokenizer.piece, tokenizer(text))).decode() == text


def test_a_mark_in_the_text_is_not_special(tokenizer: Tokenizer) -> None:
    assert len(tokenizer("<image>")) == 7


def test_what_is_no_language_model_is_told(tiny: EngineConfig, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"`model` /no/such.gguf: "):
        Tokenizer(Path("/no/such.gguf"))
    with pytest.raises(ModelError, match="this is an mmproj"):
        Tokenizer(tiny.mmproj)
    odd = tmp_path / "odd.gguf"
    odd.write_bytes(os.urandom(64))
    with pytest.raises(ModelError, match=r"odd\.gguf"):
        Tokenizer(odd)
