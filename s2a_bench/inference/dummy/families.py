"""The families: their public sizes and keys, and their tensors, under the names and keys that llama.cpp reads.

Names are those of ``src/models/*.cpp`` and ``tools/mtmd/clip.cpp``; types are those of llama.cpp's converter and of
``llama-quantize``. Sizes and keys are those of each model's ``config.json`` and ``preprocessor_config.json``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from s2a_bench.inference import Like, Quant, Size
from s2a_bench.inference.dummy.tensors import Kind, Tensor
from s2a_bench.inference.dummy.vocab import FULL_SIZE, SPECIAL, Vocab

_NEVER = -1e4
"""Added to the logits of tokens without text: servers send nothing for those, so that the first would be late."""
_SHARP = 10
"""Spread of the logits of texts where no architecture adds a bias: the other tokens' rows are 0, hence their logits."""
_QUERIES = 64


@dataclass(frozen=True, slots=True)
class Shape:
    """Sizes of a language model and its vision tower; ``head`` is the width of one head of the former."""

    layers: int
    width: int
    ffn: int
    heads: int
    kv_heads: int
    head: int
    vision_layers: int
    vision_width: int
    vision_ffn: int
    vision_heads: int


@dataclass(frozen=True, slots=True)
class Family:
    """A model to imitate: in every size, pictures cost as many tokens as in the real one.

    ``positions`` are the learned ones of patches (0: rotary), ``special`` control tokens: padding, begin, end, others.
    ``text`` and ``clip`` are llama.cpp's keys that the sizes do not give, or that differ from what most families have.
    """

    title: str
    architecture: str
    projector: str
    image: int
    patch: int
    positions: int
    shapes: dict[Size, Shape]
    text: dict[str, Any]
    clip: dict[str, Any]
    vocab: int
    special: Sequence[str]
    template: str
    pre: str = "qwen2"
    tied: bool = False

    def model_keys(self, shape: Shape, vocab: Vocab) -> dict[str, Any]:
        sizes = {
            "context_length": 32768,
            "embedding_length": shape.width,
            "block_count": shape.layers,
            "feed_forward_length": shape.ffn,
            "attention.head_count": shape.heads,
            "attention.head_count_kv": shape.kv_heads,
            "rope.freq_base": 1e6,
            "attention.layer_norm_rms_epsilon": 1e-6,
        }
        return {f"{self.architecture}.{key}": value for key, value in (sizes | self.text).items()} | {
            "tokenizer.ggml.model": "gpt2",
            "tokenizer.ggml.pre": self.pre,
            "tokenizer.ggml.tokens": vocab.tokens,
            "tokenizer.ggml.token_type": vocab.types,
            "tokenizer.ggml.merges": vocab.merges,
            "tokenizer.ggml.bos_token_id": vocab.bos,
            "tokenizer.ggml.eos_token_id": vocab.eos,
            "tokenizer.ggml.padding_token_id": vocab.pad,
            "tokenizer.ggml.unknown_token_id": vocab.unknown,
            "tokenizer.ggml.add_bos_token": "bos_token" in self.template,
            "tokenizer.chat_template": self.template,
        }

    def mmproj_keys(self, shape: Shape, width: int) -> dict[str, Any]:
        encoders = {"has_text_encoder": False, "has_vision_encoder": True}
        sizes = {
            "projector_type": self.projector,
            "vision.image_size": self.image,
            "vision.patch_size": self.patch,
            "vision.embedding_length": shape.vision_width,
            "vision.feed_forward_length": shape.vision_ffn,
            "vision.projection_dim": 0 if self.projector == "resampler" else width,
            "vision.attention.head_count": shape.vision_heads,
            "vision.attention.layer_norm_epsilon": 1e-6,
            "vision.block_count": shape.vision_layers,
            "vision.image_mean": [0.5, 0.5, 0.5],
            "vision.image_std": [0.5, 0.5, 0.5],
            "use_gelu": True,
        }
        return {f"clip.{key}": value for key, value in (encoders | self.clip | sizes | self.clip).items()}


_SYSTEM = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
_PARTS = (
    "{%% for part in message['content'] %%}{%% if part['type'] == 'image' %%}%s"
    "{%% elif part['type'] == 'text' %%}{{ part['text'] }}{%% endif %%}{%% endfor %%}"
)
_EITHER = "{%% if message['content'] is string %%}{{ message['content'] }}{%% else %%}" + _PARTS + "{%% endif %%}"
_ANSWER = "{%% endfor %%}{%% if add_generation_prompt %%}%s{%% endif %%}"

# fmt: off
FAMILIES: dict[Like, Family] = {
    "minicpm-v-2.6": Family(  # openbmb/MiniCPM-V-2_6
        title="MiniCPM-V 2.6", architecture="qwen2", projector="resampler", image=448, patch=14, positions=70 * 70,
        # the resampler's heads are 128 wide, so 256 is the smallest width with more than one; one head of 64 in the
        # vision tower, as attention over a thousand patches is most of its time (SigLIP's heads are 72 wide)
        shapes={"full": Shape(28, 3584, 18944, 28, 4, 128, 27, 1152, 4304, 16),
                "tiny": Shape(4, 256, 768, 4, 2, 64, 2, 64, 256, 1)},
        text={},
        clip={"has_minicpmv_projector": True, "projector_type": "resampler",
              "minicpmv_version": np.int32(3), "minicpmv_query_num": _QUERIES},
        vocab=FULL_SIZE, special=SPECIAL,
        # Qwen2's, with its system message: the same prompt in llama-server as in the llama engine
        template="{% for message in messages %}{% if loop.first and messages[0]['role'] != 'system' %}"
                 "{{ '" + _SYSTEM + "' }}{% endif %}"
                 "{{'<|im_start|>' + message['role'] + '\n' + message['content'] + '<|im_end|>' + '\n'}}"
                 + _ANSWER % "{{ '<|im_start|>assistant\n' }}",
    ),
    "qwen2.5-vl-3b": Family(  # Qwen/Qwen2.5-VL-3B-Instruct
        title="Qwen2.5-VL 3B", architecture="qwen2vl", projector="qwen2.5vl_merger", image=560, patch=14, positions=0,
        shapes={"full": Shape(36, 2048, 11008, 16, 2, 128, 32, 1280, 3420, 16),
                "tiny": Shape(4, 256, 768, 2, 1, 128, 8, 64, 192, 1)},  # the eighth vision layer has no windows
        text={"context_length": 128_000, "rope.dimension_sections": [16, 24, 24, 0]},
        clip={"vision.n_wa_pattern": 8, "use_gelu": False, "use_silu": True,
              "vision.image_mean": [0.48145466, 0.4578275, 0.40821073],
              "vision.image_std": [0.26862954, 0.26130258, 0.27577711]},
        vocab=151_936, tied=True,
        special=["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"],
        template="{% for message in messages %}{% if loop.first and message['role'] != 'system' %}" + _SYSTEM
                 + "{% endif %}<|im_start|>{{ message['role'] }}\n"
                 + _EITHER % "<|vision_start|><|image_pad|><|vision_end|>" + "<|im_end|>\n"
                 + _ANSWER % "<|im_start|>assistant\n",
    ),
    "smolvlm2-500m": Family(  # HuggingFaceTB/SmolVLM2-500M-Video-Instruct
        title="SmolVLM2 500M", architecture="llama", projector="idefics3", image=512, patch=16, positions=32 * 32,
        shapes={"full": Shape(32, 960, 2560, 15, 5, 64, 12, 768, 3072, 12),
                "tiny": Shape(4, 256, 768, 4, 2, 64, 2, 64, 256, 1)},
        text={"context_length": 8192, "rope.freq_base": 1e5, "attention.layer_norm_rms_epsilon": 1e-5},
        clip={"vision.preproc_image_size": 4 * 512, "vision.projector.scale_factor": 4},
        vocab=49_280, pre="smollm",
        special=["<|im_end|>", "<|im_start|>", "<end_of_utterance>", "<fake_token_around_image>", "<global-img>",
                 *(f"<row_{row}_col_{column}>" for row, column in product(range(1, 7), repeat=2))],
        template="<|im_start|>{% for message in messages %}{{ message['role'] | capitalize }}"
                 "{% if message['content'][0]['type'] == 'image' %}:{% else %}: {% endif %}"
                 + _PARTS % "<image>" + "<end_of_utterance>\n" + _ANSWER % "Assistant:",
    ),
    "gemma3-4b": Family(  # google/gemma-3-4b-it
        title="Gemma 3 4B", architecture="gemma3", projector="gemma3", image=896, patch=14, positions=64 * 64,
        shapes={"full": Shape(34, 2560, 10240, 8, 4, 256, 27, 1152, 4304, 16),
                "tiny": Shape(6, 256, 768, 2, 1, 256, 2, 64, 256, 1)},  # the sixth layer has no window
        text={"context_length": 131_072, "rope.scaling.type": "linear", "rope.scaling.factor": 8.0,
              "attention.key_length": 256, "attention.value_length": 256, "attention.sliding_window": 1024},
        clip={},
        vocab=262_208, tied=True,
        special=["<pad>", "<bos>", "<eos>", "<start_of_turn>", "<end_of_turn>", "<start_of_image>", "<end_of_image>"],
        # a system message is the beginning of the first question
        template="{{ bos_token }}{% for message in messages %}{% if message['role'] == 'assistant' %}"
                 "<start_of_turn>model\n{% elif loop.first or messages[loop.index0 - 1]['role'] != 'system' %}"
                 "<start_of_turn>user\n{% endif %}" + _EITHER % "<start_of_image>"
                 + "{% if message['role'] == 'system' %}{{ '\n\n' }}{% else %}<end_of_turn>\n{% endif %}"
                 + _ANSWER % "<start_of_turn>model\n",
    ),
}
# fmt: on


def model_tensors(
    family: Family, shape: Shape, n_vocab: int, quant: Quant, texts: Sequence[bool] = ()
) -> Iterator[Tensor]:
    """Yield the language model's tensors; with ``texts`` it writes only the tokens that this marks."""
    gemma, biased = family.architecture == "gemma3", family.architecture.startswith("qwen2")
    # only Qwen2 adds a bias to its logits; llama.cpp takes an output matrix from a file of a tied model, too
    blank = [] if family.architecture == "qwen2" else [token for token, text in enumerate(texts) if not text]
    tied, width = family.tied and not blank, shape.width
    kind: Kind = quant
    last: Kind = quant
    if quant == "q4_0":  # llama-quantize keeps the output matrix in Q6_K, if that has blocks of this width
        last = "q8_0" if width % 256 else "q6_k"
    yield Tensor("token_embd.weight", (n_vocab, width), last if tied else kind)
    for layer in range(shape.layers):
        block = f"blk.{layer}"
        yield Tensor(f"{block}.attn_norm.weight", (width,), value=1)
        for part, heads in (("q", shape.heads), ("k", shape.kv_heads), ("v", shape.kv_heads)):
            yield Tensor(f"{block}.attn_{part}.weight", (heads * shape.head, width), kind)
            if biased:
                yield Tensor(f"{block}.attn_{part}.bias", (heads * shape.head,))
        yield Tensor(f"{block}.attn_output.weight", (width, shape.heads * shape.head), kind)
        if gemma:
            yield Tensor(f"{block}.attn_q_norm.weight", (shape.head,), value=1)
            yield Tensor(f"{block}.attn_k_norm.weight", (shape.head,), value=1)
            yield Tensor(f"{block}.post_attention_norm.weight", (width,), value=1)
            yield Tensor(f"{block}.post_ffw_norm.weight", (width,), value=1)
        yield Tensor(f"{block}.ffn_norm.weight", (width,), value=1)
        yield Tensor(f"{block}.ffn_gate.weight", (shape.ffn, width), kind)
        yield Tensor(f"{block}.ffn_up.weight", (shape.ffn, width), kind)
        yield Tensor(f"{block}.ffn_down.weight", (width, shape.ffn), kind)
    yield Tensor("output_norm.weight", (width,), value=_SHARP if blank else 1)
    if not tied:
        yield Tensor("output.weight", (n_vocab, width), last, blank=blank)
    if texts and not blank:
        yield Tensor("output.bias", (n_vocab,), value=[0 if text else _NEVER for text in texts])


def mmproj_tensors(family: Family, shape: Shape, out: int) -> Iterator[Tensor]:
    """Yield the tensors of the projector, to ``out`` numbers a token, and of the tower: matrices in half precision."""
    width, rotary = shape.vision_width, not family.positions
    yield from _projector(family, width, out)
    embedding: Kind = "f16" if rotary or family.projector == "resampler" else "f32"
    kernel = width, 3, family.patch, family.patch
    yield Tensor("v.patch_embd.weight", kernel, embedding)
    if rotary:  # a picture is two frames of a film
        yield Tensor("v.patch_embd.weight.1", kernel, embedding)
    else:
        yield Tensor("v.patch_embd.bias", (width,))
        yield Tensor("v.position_embd.weight", (family.positions, width), embedding)
    for layer in range(shape.vision_layers):
        block = f"v.blk.{layer}"
        for part in ("q", "k", "v", "out"):
            yield from _linear(f"{block}.attn_{part}", width, width)
        yield from _norm(f"{block}.ln1", width, bias=not rotary)
        for part in ("gate", "up") if rotary else ("up",):
            yield from _linear(f"{block}.ffn_{part}", shape.vision_ffn, width)
        yield from _linear(f"{block}.ffn_down", width, shape.vision_ffn)
        yield from _norm(f"{block}.ln2", width, bias=not rotary)
    yield from _norm("v.post_ln", width, bias=not rotary)


def _projector(family: Family, width: int, out: int) -> Iterator[Tensor]:
    match family.projector:
        case "resampler":
            yield Tensor("resampler.query", (_QUERIES, out))
            yield Tensor("resampler.pos_embed_k", (family.positions, out))
            yield Tensor("resampler.proj.weight", (out, out), "f16")
            yield Tensor("resampler.kv.weight", (out, width), "f16")
            for part in ("q", "k", "v", "out"):
                yield from _linear(f"resampler.attn.{part}", out, out)
            for part in ("q", "kv", "post"):
                yield from _norm(f"resampler.ln_{part}", out)
        case "qwen2.5vl_merger":
            yield from _linear("mm.0", 4 * width, 4 * width)
            yield from _linear("mm.2", out, 4 * width)
        case "idefics3":
            yield Tensor("mm.model.fc.weight", (out, 4 * 4 * width), "f16")
        case "gemma3":
            yield Tensor("mm.input_projection.weight", (width, out), "f16")
            yield Tensor("mm.soft_emb_norm.weight", (width,), value=1)


def _linear(name: str, rows: int, columns: int) -> Iterator[Tensor]:
    yield Tensor(f"{name}.weight", (rows, columns), "f16")
    yield Tensor(f"{name}.bias", (rows,))


def _norm(name: str, width: int, *, bias: bool = True) -> Iterator[Tensor]:
    yield Tensor(f"{name}.weight", (width,), value=1)
    if bias:
        yield Tensor(f"{name}.bias", (width,))
