"""List the known models and those on this machine: parameters, sizes, and the tokens of a picture, counted by MTMD."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from s2a_bench.bounds import Count, about
from s2a_bench.errors import MissingExtra, ModelError
from s2a_bench.inference.gguf_file import read_header
from s2a_bench.inference.models import HUB, HUB_MODELS, cache_folder, cached, pair

_TOKENS = "Prompt tokens of one 640x480 picture as MTMD counts them, with the text tokens around its slices."


@dataclass(frozen=True, slots=True)
class ListedModel:
    """A known model, or one in the hub's cache or in the cache folder of s2a-bench."""

    name: Annotated[str, about("What --model takes.")]
    state: Literal["not here", "fetched", "dummy", "damaged"]
    bytes: Annotated[dict[str, Count], about("Path of the language model, and of its mmproj if there is one -> size.")]
    parameters: Annotated[Count | None, about("Numbers in the tensors of the files.")] = None
    picture_tokens: Annotated[Count | None, about(_TOKENS)] = None
    error: Annotated[str | None, about("Why the files cannot be read, or the tokens not be counted.")] = None


def listed() -> Iterator[ListedModel]:
    """Yield a row for each known model, then for each other one in the hub's cache, then for the dummies."""
    by_repository, fetched = {repository: name for name, repository in HUB_MODELS.items()}, cached()
    for repository in dict.fromkeys((*by_repository, *sorted(fetched))):
        models, mmproj = pair(fetched.get(repository, ()))
        name = by_repository.get(repository, f"{HUB}{repository}")
        if not models and repository in by_repository:
            yield ListedModel(name, "not here", {})
        for model in models:
            yield _row(name if len(models) == 1 else f"{HUB}{repository}:{model.name}", model, mmproj)
    for folder in sorted({path.parent for path in (cache_folder() / "models").rglob("*.gguf")}):
        models, mmproj = pair(folder.glob("*.gguf"))
        for model in models:
            yield _row(str(model), model, mmproj)


def _row(name: str, model: Path, mmproj: Path | None) -> ListedModel:
    paths = [model, mmproj] if mmproj else [model]
    row = ListedModel(name, "damaged", {str(path): path.stat().st_size for path in paths})
    try:
        headers = [read_header(path, "file") for path in paths]
        row = replace(row, state="fetched", parameters=sum(header.parameters for header in headers))
        row = replace(row, state="dummy") if any(header.is_dummy for header in headers) else row
        return replace(row, picture_tokens=picture_tokens(model, mmproj)) if mmproj else row
    except (MissingExtra, ModelError) as error:
        return replace(row, error=str(error))


def picture_tokens(model: Path, mmproj: Path, width: int = 640, height: int = 480) -> int:
    """Return the prompt tokens of one picture; no weights of the language model are read.

    Raises MissingExtra without llama-cpp-python, and ModelError if llama.cpp cannot use the files.
    """
    from s2a_bench.inference import llama_log

    llama, mtmd = llama_log.llama_cpp, llama_log.mtmd_cpp
    llama_log.silence()
    model_params, params = llama.llama_model_default_params(), mtmd.mtmd_context_params_default()
    model_params.vocab_only = True
    params.use_gpu = params.warmup = params.print_timings = False
    with ExitStack() as stack:

        def opened(path: Path, handle: Any, free: Any) -> Any:
            if not handle:
                raise ModelError(f"file {path}: llama.cpp: {llama_log.reason() or 'cannot load it'}")
            stack.callback(free, handle)
            return handle

        vocab = llama.llama_model_load_from_file(str(model).encode(), model_params)
        vocab = opened(model, vocab, llama.llama_model_free)
        context = opened(mmproj, mtmd.mtmd_init_from_file(str(mmproj).encode(), vocab, params), mtmd.mtmd_free)
        bitmap = mtmd.mtmd_bitmap_init(width, height, (ctypes.c_uint8 * (width * height * 3))())
        pictures = (mtmd.mtmd_bitmap_p_ctypes * 1)(opened(mmproj, bitmap, mtmd.mtmd_bitmap_free))
        chunks = opened(mmproj, mtmd.mtmd_input_chunks_init(), mtmd.mtmd_input_chunks_free)
        marker = mtmd.mtmd_default_marker()
        text = mtmd.mtmd_input_text(text=marker, text_len=len(marker), add_special=False, parse_special=True)
        if mtmd.mtmd_tokenize(context, chunks, ctypes.byref(text), pictures, 1):
            raise ModelError(f"file {mmproj}: llama.cpp: {llama_log.reason() or 'cannot cut a picture'}")
        return int(mtmd.mtmd_helper_get_n_tokens(chunks))
