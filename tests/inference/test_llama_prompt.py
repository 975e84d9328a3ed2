"""Prompts of the llama engine: chat templates, models of texts alone, and a real language model."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.errors import BadRequest, ModelError, UsageError
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.llama_prompt import MARKER, ChatTemplate
from s2a_bench.inference.models import RAW_PROMPT, load_headers
from s2a_bench.testing.engine import EngineSuite, ask, rgb_frame

PARTS = (
    "{{ bos_token }}{% for message in messages %}<{{ message['role'] }}>"
    "{% for part in message['content'] %}{% if part['type'] == 'text' %}{{ part['text'] }}{% endif %}{% endfor %}"
    "{% endfor %}{% if add_generation_prompt %}<model>{% endif %}"
)
TEXT = "{% for message in messages %}{{ '<' + message.role + '>' + message.content + eos_token }}{% endfor %}"
EITHER = (
    "{% for message in messages %}{% if message.content is string %}{{ message.content }}{% else %}"
    "{% for part in message.content %}[{{ part.text }}]{% endfor %}{% endif %}{% endfor %}"
)


@pytest.fixture(scope="module")
def blind(texts: EngineConfig) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(texts)
    yield engine
    engine.close()


class TestTextModel(EngineSuite):
    @pytest.fixture
    def engine(self, blind: LlamaCppEngine) -> Engine:
        return blind

    @pytest.fixture
    def fresh_engine(self, texts: EngineConfig) -> LlamaCppEngine:
        return LlamaCppEngine(texts)


def vocab_of(engine: LlamaCppEngine) -> Any:
    return engine._llama._model.vocab


@pytest.fixture(scope="module")
def vocab(tiny: EngineConfig) -> Iterator[Any]:
    engine = LlamaCppEngine(tiny)
    yield vocab_of(engine)
    engine.close()


@pytest.fixture(scope="module")
def base(gemma: Path) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(EngineConfig(model=gemma, chat_template="none", sampling="greedy", threads=2))
    yield engine
    engine.close()


@pytest.mark.parametrize(
    ("source", "prompt"),
    [
        (PARTS, "<|im_start|><user>{0}{0}go<model>"),
        (TEXT, "<user>{0}{0}go<|im_end|>"),
        (EITHER, "[{0}{0}go]"),
        (RAW_PROMPT, "{0}{0}go"),
    ],
)
def test_a_template_takes_parts_or_one_text(vocab: Any, source: str, prompt: str) -> None:
    assert ChatTemplate(source, vocab).prompt("go", 2) == prompt.format(MARKER)


def test_what_the_tokenizer_adds_is_not_there_twice(base: LlamaCppEngine) -> None:
    assert ChatTemplate(PARTS, vocab_of(base)).prompt("go", 0) == "<user>go<model>"
    for prompt in ("go", "<bos>go"):
        ask(base, prompt, max_tokens=1)
        assert base._llama.eval_tokens[0] == 2
        assert base._llama.eval_tokens[1] != 2


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("{% if", "TemplateSyntaxError: unexpected 'end of template'"),
        ("{{ messages | rot13 }}", "No filter named 'rot13'"),
        ("{{ raise_exception('tools alone') }}", "tools alone"),
        ("{{ messages[1].content }}", "UndefinedError"),
        ("hello", "ValueError: it does not render the message"),
        ("{{ messages[0].content[:9] }}", "it does not render the message"),
    ],
)
def test_a_template_that_renders_nothing_is_a_line(texts: EngineConfig, tmp_path: Path, source: str, why: str) -> None:
    file = tmp_path / "mine.jinja"
    file.write_text(source)
    with pytest.raises(ModelError, match=rf"^`chat_template` {file}: .*{why}"):
        LlamaCppEngine(texts.but(chat_template=str(file)))


def test_a_template_that_cannot_be_read_is_a_line(texts: EngineConfig, tmp_path: Path) -> None:
    for content in (None, b"\xff", b"", b"x" * (2 << 20)):
        file = tmp_path / "mine.jinja"
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(ModelError, match=rf"^`chat_template` {file}: cannot be read"):
            load_headers(texts.but(chat_template=str(file)))


def test_a_model_without_a_template_names_the_ways_out(gemma: Path) -> None:
    with pytest.raises(
        ModelError, match="has no chat template; give `chat_template`: a FILE, or none for the raw prompt"
    ):
        load_headers(EngineConfig(model=gemma))


def test_a_template_is_for_an_engine_with_a_model() -> None:
    with pytest.raises(UsageError, match="`chat_template` is for an engine with a model"):
        EngineConfig(name="echo", chat_template="none").check()


def test_a_model_of_texts_does_not_see_the_picture(blind: LlamaCppEngine) -> None:
    facts = blind.describe()
    seen = ask(blind, images=(rgb_frame(1),))
    assert "vision_encode_ms" not in blind.facts
    assert seen == ask(blind, images=(rgb_frame(2),)) == ask(blind)
    assert facts["pictures"] == "not seen"
    assert not {"mmproj", "mmproj_sha256", "projector"} & set(facts)
    with pytest.raises(BadRequest, match="640x480 whose data are"):
        ask(blind, images=(replace(rgb_frame(), width=640, height=480),))


def test_a_prompt_without_a_token_is_refused(texts: EngineConfig, tiny: EngineConfig) -> None:
    for config in (texts, tiny):
        engine = LlamaCppEngine(config.but(chat_template="none"))
        with pytest.raises(BadRequest, match="a prompt without a token; write one"):
            ask(engine, "")
        assert ask(engine, "go")
        engine.close()


def test_a_real_model_goes_on_with_the_raw_prompt(base: LlamaCppEngine) -> None:
    prompt = "1. pick(cup)\n2. place(cup, table)\n3."
    answer = "".join(token.text for token in ask(base, prompt, max_tokens=24))
    assert "(" in answer
    assert "\n4." in answer
    assert answer == "".join(token.text for token in ask(base, prompt, max_tokens=24, images=(rgb_frame(),)))
    assert (base.facts["prompt_n"], base.facts["predicted_n"]) == (base._llama.n_tokens, 24)  # type: ignore[union-attr]
