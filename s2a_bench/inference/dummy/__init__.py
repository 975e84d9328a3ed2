"""Write shape-faithful dummy weights: a model's architecture with random numbers, as two GGUF files.

Token speed depends on shapes and types, not on values. `families` has the models.

Weights are drawn as bytes of each type's blocks, not quantised from floats, from a generator of 64-bit integers: they
are the same bytes with every numpy. A matrix has a spread of about ``1 / sqrt(columns)``, so that activations keep
their size through the layers.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from uuid import uuid4

import numpy as np

from s2a_bench import extras
from s2a_bench.errors import ModelError
from s2a_bench.inference import Like, Quant, Size
from s2a_bench.inference.dummy.families import FAMILIES, Family, mmproj_tensors, model_tensors
from s2a_bench.inference.dummy.tensors import Tensor
from s2a_bench.inference.dummy.vocab import make_vocab

Progress: TypeAlias = Callable[[int, int], None]
"""(bytes written, total bytes) -> None."""

REVISION = 3
"""Part of the file names; increase it when the bytes change, so that old files in caches are not used."""

DUMMY_KEY = "s2a_bench.dummy"
_TYPES = {bool: "bool", str: "string", int: "uint32", float: "float32", list: "array", np.int32: "int32"}
"""Type in Python -> in the files, as `GGUFWriter` calls it."""
_FILE_TYPES = {"f16": 1, "q4_0": 2, "q8_0": 7}  # llama_ftype


class DummyFiles(NamedTuple):
    model: Path
    mmproj: Path


def dummy_files(folder: Path, size: Size, quant: Quant, *, like: Like = "minicpm-v-2.6") -> DummyFiles:
    name = FAMILIES[like].title.replace(" ", "-").replace(".", "_")
    stem = f"{name}-dummy-{size}-r{REVISION}-s0"
    return DummyFiles(folder / f"{stem}-{quant}.gguf", folder / f"mmproj-{stem}-f16.gguf")


def write_dummy(
    folder: Path,
    size: Size = "tiny",
    quant: Quant = "f16",
    *,
    progress: Progress | None = None,
    like: Like = "minicpm-v-2.6",
) -> DummyFiles:
    """Write both files into ``folder``; each gets its name once it is complete.

    Two processes may write the same files at once. Raises ModelError if the folder cannot be written.
    """
    family = FAMILIES[like]
    shape, files = family.shapes[size], dummy_files(folder, size, quant, like=like)
    vocab = make_vocab(full=size == "full", size=family.vocab, special=family.special)
    texts = vocab.texts() if size == "tiny" else ()  # half of its few tokens have no text
    tensors = list(model_tensors(family, shape, len(vocab.tokens), quant, texts))
    done, total = 0, sum(tensor.nbytes for tensor in (*tensors, *mmproj_tensors(family, shape, shape.width)))

    def written(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, total)

    write_mmproj(files.mmproj, shape.width, size, like=like, written=written)
    keys = _general_keys(family, size, quant, "language model") | family.model_keys(shape, vocab)
    _write(files.model, family.architecture, keys, tensors, written)
    return files


def write_mmproj(
    path: Path, width: int, size: Size, *, like: Like, written: Callable[[int], None] | None = None
) -> None:
    """Write a vision tower with its projector for a language model that is ``width`` wide; raises ModelError."""
    family = FAMILIES[like]
    shape = family.shapes[size]
    keys = _general_keys(family, size, "f16", f"vision tower and {family.projector}") | family.mmproj_keys(shape, width)
    _write(path, "clip", keys, list(mmproj_tensors(family, shape, width)), written or (lambda _: None))


def _general_keys(family: Family, size: Size, quant: Quant, content: str) -> dict[str, Any]:
    return {
        "general.name": f"{family.title} {content}, DUMMY random weights ({size})",
        "general.description": f"Random weights in the shapes of {family.title}, "
        "for timing only; written by s2a-bench.",
        DUMMY_KEY: True,
        "s2a_bench.dummy_size": size,
        "general.file_type": _FILE_TYPES[quant],
        "general.quantization_version": 2,
    }


def _write(path: Path, kind: str, keys: dict[str, Any], tensors: list[Tensor], written: Callable[[int], None]) -> None:
    """Write one file of llama.cpp's architecture ``kind``."""
    gguf = extras.require("gguf", "model")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid4().hex}.part")
        writer = gguf.GGUFWriter(temporary, kind)
        try:
            for key, value in keys.items():
                getattr(writer, f"add_{_TYPES[type(value)]}")(key, value)
            for tensor in tensors:
                block = gguf.GGMLQuantizationType[tensor.kind.upper()]
                writer.add_tensor_info(tensor.name, tensor.shape, np.dtype(np.float32), tensor.nbytes, raw_dtype=block)
            writer.write_header_to_file()
            writer.write_kv_data_to_file()
            writer.write_ti_data_to_file()
            (file,) = writer.fout
            writer.write_padding(file, file.tell())
            for tensor in tensors:
                for part in tensor.parts():
                    file.write(part.data)
                    written(part.nbytes)
                writer.write_padding(file, tensor.nbytes)
            writer.close()
            temporary.replace(path)
        finally:
            writer.close()
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise ModelError(
            f"`output` {path.parent}: cannot write {path.name} ({error.strerror or error}); "
            f"it needs {sum(tensor.nbytes for tensor in tensors) / 1e9:.2f} GB, choose another folder"
        ) from error
