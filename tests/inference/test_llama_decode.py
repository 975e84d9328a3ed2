"""Our decoding loop against llama-cpp-python's own, which is the slow and obvious one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product

import llama_cpp
import pytest

from s2a_bench.errors import EngineError
from s2a_bench.inference import SAMPLINGS, EngineConfig
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.llama_decode import bindings
from s2a_bench.testing.engine import ask, rgb_frame
from s2a_bench.types import Frame, Request


@pytest.fixture(scope="module", params=["model", "greedy"])
def engine(request: pytest.FixtureRequest, tiny: EngineConfig) -> Iterator[LlamaCppEngine]:
    engine = LlamaCppEngine(tiny.but(sampling=request.param))
    yield engine
    engine.close()


def by_the_library(engine: LlamaCppEngine, request: Request) -> list[int]:
    """Answer with ``Llama.generate``."""
    llama = engine._llama
    engine._evaluate(llama, request)
    llama.set_seed(request.seed)
    tokens = llama.generate(list(llama.eval_tokens), **SAMPLINGS[engine._config.sampling])
    return list(islice(tokens, request.max_tokens))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("images", [(), (rgb_frame(1),), (rgb_frame(2), rgb_frame(3))])
def test_it_writes_the_tokens_that_the_library_writes(
    engine: LlamaCppEngine, seed: int, images: tuple[Frame, ...]
) -> None:
    request = Request("r", f"skill {seed}", images, max_tokens=70, seed=seed)
    ours = [token.id for token in engine.generate(request)]
    assert ours == by_the_library(engine, request)
    assert len(ours) == 70


def test_greedy_does_not_depend_on_the_seed(tiny: EngineConfig) -> None:
    engine = LlamaCppEngine(tiny.but(sampling="greedy"))
    assert ask(engine, seed=1, max_tokens=20) == ask(engine, seed=2, max_tokens=20)
    grammar = 'root ::= ("a" | "b"){20}'
    under = {"".join(token.text for token in ask(engine, seed=seed, max_tokens=30, grammar=grammar)) for seed in (1, 2)}
    assert len(under) == 1
    assert set(under.pop()) <= set("ab")
    engine.close()


def test_a_tokens_bytes_are_the_librarys(engine: LlamaCppEngine) -> None:
    llama = engine._llama
    for token in range(0, llama._n_vocab, 7):
        known = engine._pieces[token]
        assert engine._pieces[token] is known
        assert known in {llama.detokenize([token]), b""}  # special tokens have none here


@pytest.mark.parametrize(
    ("kv_type", "flash_attention"),
    [*product(["f32", "f16", "q8_0", "q4_0"], ["auto", "on"]), ("f32", "off"), ("f16", "off")],
)
def test_kv_types_and_flash_attention_reach_llama_cpp(tiny: EngineConfig, kv_type: str, flash_attention: str) -> None:
    config = tiny.but(kv_type=kv_type, flash_attention=flash_attention, context=512, batch=64)
    engine = LlamaCppEngine(config)
    llama = engine._llama
    params = llama.context_params
    assert (params.type_k, params.type_v, params.flash_attn_type) == (
        {"f32": 0, "f16": 1, "q8_0": 8, "q4_0": 2}[kv_type],
        {"f32": 0, "f16": 1, "q8_0": 8, "q4_0": 2}[kv_type],
        {"auto": -1, "on": 1, "off": 0}[flash_attention],
    )
    assert (llama_cpp.llama_n_batch(llama.ctx), llama_cpp.llama_n_ubatch(llama.ctx)) == (64, 64)
    assert len(ask(engine, images=(rgb_frame(),), max_tokens=20)) == 20
    facts = engine.describe()
    assert (facts["kv_type"], facts["flash_attention"], facts["batch"]) == (kv_type, flash_attention, 64)
    engine.close()


def test_a_decoding_that_fails_is_an_engine_error(engine: LlamaCppEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    decode = bindings.llama_decode
    monkeypatch.setattr(bindings, "llama_decode", lambda ctx, batch: decode(ctx, batch) if batch.n_tokens > 1 else 1)
    tokens = engine.generate(Request("r", "go", max_tokens=9))
    assert next(tokens).index == 0  # its logits are the prompt's
    with pytest.raises(EngineError, match="generation failed: llama_decode returned 1"):
        next(tokens)
    monkeypatch.undo()
    assert len(ask(engine)) == 6
