"""Write shape-faithful dummy weights: MiniCPM-V 2.6's architecture with random numbers, as two GGUF files.

Token speed depends on shapes and types, not on values. The language model is Qwen2-7B's; the mmproj is SigLIP-so400m
at 980 pixels' positions with a `resampler` of 64 queries (minicpmv_version 3). Names and keys are those that llama.cpp
reads (``src/models/qwen2.cpp``, ``tools/mtmd/clip.cpp``) and its converter writes (``tools/mtmd/legacy-models``).

Weights are drawn as bytes of each type's blocks, not quantised from floats, from a generator of 64-bit integers: a seed
gives the same bytes with every numpy. A matrix has a spread of about ``1 / sqrt(columns)``, so that activations keep
their size through the layers.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from s2a_bench import extras
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference import Quant, Size
from s2a_bench.inference.dummy.tensors import Kind, Tensor
from s2a_bench.inference.dummy.vocab import Vocab, make_vocab
from s2a_bench.text import none_of

if TYPE_CHECKING:
    from gguf import GGUFWriter

Progress: TypeAlias = Callable[[int, int], None]
"""(bytes written, total bytes) -> None."""

REVISION = 3
"""Part of the file names; increase it when the bytes change, so that old files in caches are not used."""

DUMMY_KEY = "s2a_bench.dummy"
_CHAT_TEMPLATE = (  # Qwen2's, with its system message: the same prompt in llama-server as in the llama engine
    "{% for message in messages %}{% if loop.first and messages[0]['role'] != 'system' %}"
    "{{ '<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n' }}{% endif %}"
    "{{'<|im_start|>' + message['role'] + '\n' + message['content'] + '<|im_end|>' + '\n'}}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{% endif %}"
)
_NEVER = -1e4
"""Added to the logits of tokens that are no text: servers send nothing for those, so that the first would be late."""
_POSITIONS = 70 * 70
_PATCH = 14
_QUERIES = 64
_MEAN_STD = [0.5, 0.5, 0.5]
_FILE_TYPES = {"f16": 1, "q4_0": 2, "q8_0": 7}  # llama_ftype


@dataclass(frozen=True, slots=True)
class Shape:
    layers: int
    width: int
    ffn: int
    heads: int
    kv_heads: int
    vision_layers: int
    vision_width: int
    vision_ffn: int
    vision_heads: int


SHAPES: dict[Size, Shape] = {
    # the resampler's heads are 128 wide, so 256 is the smallest width with more than one; one head of 64 in the
    # vision tower, as attention over a thousand patches is most of its time (SigLIP's heads are 72 wide)
    "tiny": Shape(4, 256, 768, 4, 2, 2, 64, 256, 1),
    "full": Shape(28, 3584, 18944, 28, 4, 27, 1152, 4304, 16),
}


class DummyFiles(NamedTuple):
    model: Path
    mmproj: Path


def dummy_files(folder: Path, size: Size, quant: Quant, seed: int = 0) -> DummyFiles:
    stem = f"MiniCPM-V-2_6-dummy-{size}-r{REVISION}-s{seed}"
    return DummyFiles(folder / f"{stem}-{quant}.gguf", folder / f"mmproj-{stem}-f16.gguf")


def write_dummy(
    folder: Path, size: Size = "tiny", quant: Quant = "f16", *, seed: int = 0, progress: Progress | None = None
) -> DummyFiles:
    """Write both files into ``folder``; each gets its name once it is complete.

    Two processes may write the same files at once. Raises UsageError for an unknown size or type, ModelError
    if the folder cannot be written.
    """
    if size not in SHAPES:
        raise UsageError(f"`size`: {none_of(size, SHAPES)}")
    if quant not in _FILE_TYPES:
        raise UsageError(f"`quant`: {none_of(quant, _FILE_TYPES)}")
    shape = SHAPES[size]
    files = dummy_files(folder, size, quant, seed)
    vocab = make_vocab(full=size == "full")
    model, mmproj = list(_model_tensors(shape, len(vocab.tokens), quant)), list(_mmproj_tensors(shape))
    if size == "tiny":  # half of its few tokens are no text
        biases = [0 if text else _NEVER for text in vocab.texts()]
        model.append(Tensor("output.bias", (len(vocab.tokens),), value=biases))
    done, total = 0, sum(tensor.nbytes for tensor in (*model, *mmproj))

    def written(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _writer(files.mmproj, "clip") as writer:
            _mmproj_keys(writer, shape, size)
            _write(writer, mmproj, seed, written)
        with _writer(files.model, "qwen2") as writer:
            _model_keys(writer, shape, size, quant, vocab)
            _write(writer, model, seed, written)
    except OSError as error:
        raise ModelError(
            f"`output` {folder}: cannot write the dummy model ({error.strerror or error}); "
            f"it needs {total / 1e9:.2f} GB, choose another folder"
        ) from error
    return files


@contextmanager
def _writer(path: Path, architecture: str) -> Iterator[GGUFWriter]:
    gguf = extras.require("gguf", "model")
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    os.close(handle)
    temporary = Path(name)
    writer: GGUFWriter = gguf.GGUFWriter(temporary, architecture)
    try:
        yield writer
        writer.close()
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        writer.close()
        temporary.unlink(missing_ok=True)


def _write(writer: GGUFWriter, tensors: Iterable[Tensor], seed: int, written: Callable[[int], None]) -> None:
    kinds = extras.require("gguf", "model").GGMLQuantizationType
    for tensor in tensors:
        kind = kinds[tensor.kind.upper()]
        writer.add_tensor_info(tensor.name, tensor.shape, np.dtype(np.float32), tensor.nbytes, raw_dtype=kind)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_ti_data_to_file()
    (file,) = writer.fout
    writer.write_padding(file, file.tell())
    for tensor in tensors:
        for part in tensor.parts(seed):
            file.write(part.data)
            written(part.nbytes)
        writer.write_padding(file, tensor.nbytes)


def _general_keys(writer: GGUFWriter, size: Size, quant: Quant, content: str) -> None:
    writer.add_name(f"MiniCPM-V 2.6 {content}, DUMMY random weights ({size})")
    writer.add_description("Random weights in the shapes of MiniCPM-V 2.6, for timing only; written by s2a-bench.")
    writer.add_bool(DUMMY_KEY, val=True)
    writer.add_string("s2a_bench.dummy_size", size)
    writer.add_file_type(_FILE_TYPES[quant])
    writer.add_quantization_version(2)


def _model_keys(writer: GGUFWriter, shape: Shape, size: Size, quant: Quant, vocab: Vocab) -> None:
    _general_keys(writer, size, quant, "language model")
    writer.add_context_length(32768)
    writer.add_embedding_length(shape.width)
    writer.add_block_count(shape.layers)
    writer.add_feed_forward_length(shape.ffn)
    writer.add_head_count(shape.heads)
    writer.add_head_count_kv(shape.kv_heads)
    writer.add_rope_freq_base(1_000_000.0)
    writer.add_layer_norm_rms_eps(1e-6)
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("qwen2")
    writer.add_token_list(vocab.tokens)
    writer.add_token_types(vocab.types)
    writer.add_token_merges(vocab.merges)
    writer.add_bos_token_id(vocab.bos)
    writer.add_eos_token_id(vocab.eos)
    writer.add_pad_token_id(vocab.pad)
    writer.add_unk_token_id(vocab.unknown)
    writer.add_add_bos_token(value=False)
    writer.add_chat_template(_CHAT_TEMPLATE)


def _model_tensors(shape: Shape, n_vocab: int, quant: Quant) -> Iterator[Tensor]:
    """Yield Qwen2's tensors in the types that llama-quantize gives them."""
    kind: Kind = quant
    width, kv_width = shape.width, shape.width // shape.heads * shape.kv_heads
    yield Tensor("token_embd.weight", (n_vocab, width), kind)
    for layer in range(shape.layers):
        block = f"blk.{layer}"
        yield Tensor(f"{block}.attn_norm.weight", (width,), value=1)
        for part, rows in (("q", width), ("k", kv_width), ("v", kv_width)):
            yield Tensor(f"{block}.attn_{part}.weight", (rows, width), kind)
            yield Tensor(f"{block}.attn_{part}.bias", (rows,))
        yield Tensor(f"{block}.attn_output.weight", (width, width), kind)
        yield Tensor(f"{block}.ffn_norm.weight", (width,), value=1)
        yield Tensor(f"{block}.ffn_gate.weight", (shape.ffn, width), kind)
        yield Tensor(f"{block}.ffn_up.weight", (shape.ffn, width), kind)
        yield Tensor(f"{block}.ffn_down.weight", (width, shape.ffn), kind)
    yield Tensor("output_norm.weight", (width,), value=1)
    # llama-quantize keeps the output matrix of a Q4_0 model in Q6_K
    yield Tensor("output.weight", (n_vocab, width), "q6_k" if quant == "q4_0" else kind)


def _mmproj_keys(writer: GGUFWriter, shape: Shape, size: Size) -> None:
    _general_keys(writer, size, "f16", "vision tower and resampler")
    writer.add_bool("clip.has_text_encoder", val=False)
    writer.add_bool("clip.has_vision_encoder", val=True)
    writer.add_bool("clip.has_minicpmv_projector", val=True)
    writer.add_string("clip.projector_type", "resampler")
    writer.add_int32("clip.minicpmv_version", 3)
    writer.add_uint32("clip.minicpmv_query_num", _QUERIES)
    writer.add_uint32("clip.vision.image_size", 448)
    writer.add_uint32("clip.vision.patch_size", _PATCH)
    writer.add_uint32("clip.vision.embedding_length", shape.vision_width)
    writer.add_uint32("clip.vision.feed_forward_length", shape.vision_ffn)
    writer.add_uint32("clip.vision.projection_dim", 0)
    writer.add_uint32("clip.vision.attention.head_count", shape.vision_heads)
    writer.add_float32("clip.vision.attention.layer_norm_epsilon", 1e-6)
    writer.add_uint32("clip.vision.block_count", shape.vision_layers)
    writer.add_array("clip.vision.image_mean", _MEAN_STD)
    writer.add_array("clip.vision.image_std", _MEAN_STD)
    writer.add_bool("clip.use_gelu", val=True)


def _mmproj_tensors(shape: Shape) -> Iterator[Tensor]:
    """Yield SigLIP's and the resampler's tensors: matrices in half, all else in single precision."""
    width, out = shape.vision_width, shape.width
    yield Tensor("resampler.query", (_QUERIES, out))
    yield Tensor("resampler.pos_embed_k", (_POSITIONS, out))
    yield Tensor("resampler.proj.weight", (out, out), "f16")
    yield Tensor("resampler.kv.weight", (out, width), "f16")
    for part in ("q", "k", "v", "out"):
        yield from _linear(f"resampler.attn.{part}", out, out)
    for part in ("q", "kv", "post"):
        yield from _norm(f"resampler.ln_{part}", out)
    yield Tensor("v.patch_embd.weight", (width, 3, _PATCH, _PATCH), "f16")
    yield Tensor("v.patch_embd.bias", (width,))
    yield Tensor("v.position_embd.weight", (_POSITIONS, width), "f16")
    for layer in range(shape.vision_layers):
        block = f"v.blk.{layer}"
        for part in ("q", "k", "v", "out"):
            yield from _linear(f"{block}.attn_{part}", width, width)
        yield from _norm(f"{block}.ln1", width)
        yield from _linear(f"{block}.ffn_up", shape.vision_ffn, width)
        yield from _linear(f"{block}.ffn_down", width, shape.vision_ffn)
        yield from _norm(f"{block}.ln2", width)
    yield from _norm("v.post_ln", width)


def _linear(name: str, rows: int, columns: int) -> Iterator[Tensor]:
    yield Tensor(f"{name}.weight", (rows, columns), "f16")
    yield Tensor(f"{name}.bias", (rows,))


def _norm(name: str, width: int) -> Iterator[Tensor]:
    yield Tensor(f"{name}.weight", (width,), value=1)
    yield Tensor(f"{name}.bias", (width,))
