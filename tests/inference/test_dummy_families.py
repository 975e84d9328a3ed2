"""Dummies of each family in the real llama.cpp: what a picture costs, how it is decoded, and what is answered."""

from __future__ import annotations

import base64
import ctypes
import io
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, get_args

import numpy as np
import pytest
from PIL import Image

from s2a_bench.inference import Like, Quant
from s2a_bench.inference.dummy import DummyFiles, write_dummy
from s2a_bench.inference.dummy.families import FAMILIES, mmproj_tensors, model_tensors
from s2a_bench.inference.dummy.tensors import Tensor
from s2a_bench.inference.dummy.vocab import TEXT, make_vocab

gguf = pytest.importorskip("gguf")
llama_cpp = pytest.importorskip("llama_cpp")
mtmd_cpp = pytest.importorskip("llama_cpp.mtmd_cpp")
chat_format = pytest.importorskip("llama_cpp.llama_chat_format")

LIKES: tuple[Like, ...] = get_args(Like)
PARTS_LIKES = LIKES[1:]
"""The families whose chat templates take a list of parts; MiniCPM-V 2.6's takes a text."""
WIDTH, HEIGHT = 640, 480


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Like, Quant], DummyFiles]:
    folder = tmp_path_factory.mktemp("dummies")
    return lambda like, quant="f16": write_dummy(folder / like, "tiny", quant, like=like)


@contextmanager
def loaded(files: DummyFiles) -> Iterator[tuple[Any, Any]]:
    """A language model of llama-cpp-python and the MTMD context over it."""
    handler = chat_format.MTMDChatHandler(clip_model_path=str(files.mmproj), verbose=False)
    llama = llama_cpp.Llama(
        str(files.model), chat_handler=handler, n_ctx=4096, n_batch=1024, n_threads=1, n_threads_batch=1, verbose=False
    )
    handler._init_mtmd_context(llama)
    yield llama, handler.mtmd_ctx
    llama.close()


def picture_tokens(context: Any) -> tuple[int, bool]:
    """What MTMD makes of one picture: its tokens, and whether they are decoded without the causal mask."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pointer = pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
    bitmap = mtmd_cpp.mtmd_bitmap_init(WIDTH, HEIGHT, pointer)
    chunks, text = mtmd_cpp.mtmd_input_chunks_init(), mtmd_cpp.mtmd_input_text()
    text.text = mtmd_cpp.mtmd_default_marker()
    text.text_len = len(text.text)
    assert mtmd_cpp.mtmd_tokenize(context, chunks, text, (mtmd_cpp.mtmd_bitmap_p_ctypes * 1)(bitmap), 1) == 0
    found = [mtmd_cpp.mtmd_input_chunks_get(chunks, index) for index in range(mtmd_cpp.mtmd_input_chunks_size(chunks))]
    pictures = [one for one in found if mtmd_cpp.mtmd_input_chunk_get_type(one) == mtmd_cpp.MTMD_INPUT_CHUNK_TYPE_IMAGE]
    tokens = sum(mtmd_cpp.mtmd_input_chunk_get_n_tokens(one) for one in pictures)
    non_causal = {mtmd_cpp.mtmd_decode_use_non_causal(context, one) for one in pictures}
    mtmd_cpp.mtmd_input_chunks_free(chunks)
    mtmd_cpp.mtmd_bitmap_free(bitmap)
    (answer,) = non_causal
    return tokens, answer


RULES: dict[Like, int] = {
    # 64 queries for the picture in small, and for each slice: as many as 448x448 squares have its area
    "minicpm-v-2.6": 64 * (1 + math.ceil(WIDTH * HEIGHT / 448**2)),
    # one token for 28x28 pixels, of sides rounded to that
    "qwen2.5-vl-3b": round(WIDTH / 28) * round(HEIGHT / 28),
    # 64 tokens for the picture in small, and for each tile of 512x512 of the picture with a longer side of 2048
    "smolvlm2-500m": 64 * (1 + math.ceil(2048 / 512) * math.ceil(2048 * HEIGHT / WIDTH / 512)),
    # 256 tokens for each picture (``mm_tokens_per_image``)
    "gemma3-4b": 256,
}
"""Tokens of a picture in the real models."""


@pytest.mark.parametrize("like", LIKES)
def test_a_picture_costs_what_it_costs_in_the_real_model(like: Like, tiny: Callable[[Like], DummyFiles]) -> None:
    with loaded(tiny(like)) as (_, context):
        tokens, non_causal = picture_tokens(context)
        assert tokens == RULES[like]
        assert non_causal == (like == "gemma3-4b")
        assert mtmd_cpp.mtmd_decode_use_mrope(context) == (like == "qwen2.5-vl-3b")


def picture_url() -> str:
    pixels = np.add.outer(np.arange(HEIGHT // 3), np.arange(WIDTH))[..., None].repeat(3, axis=2).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def question() -> list[dict[str, Any]]:
    picture = {"type": "image_url", "image_url": {"url": picture_url()}}
    return [{"role": "user", "content": [picture, {"type": "text", "text": "What is here?"}]}]


@pytest.mark.parametrize(
    ("like", "quant"),
    [*((like, "f16") for like in PARTS_LIKES), *((LIKES[-1], quant) for quant in get_args(Quant)[1:])],
)
def test_it_answers_about_a_picture_with_texts_only(
    like: Like, quant: Quant, tiny: Callable[[Like, Quant], DummyFiles]
) -> None:
    with loaded(tiny(like, quant)) as (llama, _):
        answer = llama.create_chat_completion(question(), max_tokens=48, seed=1, temperature=1)
        assert answer["usage"]["completion_tokens"] == 48
        text = answer["choices"][0]["message"]["content"]
        assert len(text) >= 48
        assert set(text) <= TEXT


@pytest.mark.parametrize("like", PARTS_LIKES)
def test_a_token_that_is_no_text_has_a_row_of_zeros(like: Like, tiny: Callable[[Like, Quant], DummyFiles]) -> None:
    for quant in get_args(Quant):
        header = gguf.GGUFReader(tiny(like, quant).model)
        (output,) = (tensor for tensor in header.tensors if tensor.name == "output.weight")
        rows = gguf.dequantize(output.data, output.tensor_type)
        family = FAMILIES[like]
        texts = make_vocab(full=False, special=family.special).texts()
        assert [bool(row.any()) for row in rows] == texts
        assert rows[texts].std() == pytest.approx(1 / math.sqrt(256), rel=0.4)


def parameters(tensors: Iterator[Tensor]) -> int:
    return sum(math.prod(tensor.shape) for tensor in tensors)


@pytest.mark.parametrize(
    ("like", "model", "tower"),
    [
        # the model cards' 3.75 billion, of which Qwen2.5-3B has 3.09 and the tower 0.67 (technical report, table 1)
        ("qwen2.5-vl-3b", 3_085_938_688, 668_684_288),
        # 507 million on the model card: SmolLM2-360M with an output matrix of its own, SigLIP-B/16 512, a projection
        ("smolvlm2-500m", 409_252_800, 98_229_504),
        # 4.30 billion on the model card; the report's table 1: 417 million in the tower, 3,209 and 675 without it
        ("gemma3-4b", 3_880_263_168, 419_816_304),
    ],
)
def test_full_size_has_the_real_models_parameters(like: Like, model: int, tower: int) -> None:
    family, shape = FAMILIES[like], FAMILIES[like].shapes["full"]
    assert parameters(model_tensors(family, shape, family.vocab, "q4_0")) == model
    assert parameters(mmproj_tensors(family, shape, shape.width)) == tower


@pytest.mark.parametrize("like", LIKES)
@pytest.mark.parametrize("quant", get_args(Quant))
@pytest.mark.parametrize("size", ["tiny", "full"])
def test_rows_are_whole_blocks(like: Like, quant: Quant, size: Any) -> None:
    family, shape = FAMILIES[like], FAMILIES[like].shapes[size]
    for tensor in (*model_tensors(family, shape, 1024, quant), *mmproj_tensors(family, shape, shape.width)):
        block, _ = gguf.GGML_QUANT_SIZES[gguf.GGMLQuantizationType[tensor.kind.upper()]]
        assert tensor.shape[-1] % block == 0, tensor.name


@pytest.mark.parametrize("like", LIKES)
def test_the_full_vocabulary_has_the_real_ones_size(like: Like) -> None:
    family = FAMILIES[like]
    vocab = make_vocab(full=True, size=family.vocab, special=family.special)
    assert len(vocab.tokens) == len(vocab.types) == len(set(vocab.tokens)) == family.vocab
    assert vocab.tokens[vocab.pad : vocab.eos + 1] == [*family.special[:3]]
