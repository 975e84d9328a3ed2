"""Pictures for llama.cpp: llama-cpp-python's MiniCPM-V 2.6 handler with RGB pixels as input."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.inference import llama_log
from s2a_bench.types import Frame

llama_cpp = extras.require("llama_cpp", "llama")
chat_format = extras.require("llama_cpp.llama_chat_format", "llama")
mtmd_cpp = extras.require("llama_cpp.mtmd_cpp", "llama")

_NO_CALLBACK = mtmd_cpp.mtmd_helper_post_decode_callback()


class Steps:
    """MTMD's bindings, except that a call of the library's handler is split into steps, each timed.

    ``prepared_ns`` is the time at which the last prompt was tokenised and its pictures sliced; ``encode_ns`` is the
    vision tower's time for them so far.
    """

    def __init__(self) -> None:
        self.prepared_ns = 0
        self.encode_ns = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(mtmd_cpp, name)

    def mtmd_tokenize(self, *arguments: Any) -> int:
        failed: int = mtmd_cpp.mtmd_tokenize(*arguments)
        self.prepared_ns, self.encode_ns = now_ns(), 0
        return failed

    def mtmd_helper_eval_chunk_single(
        self, mtmd: Any, llama: Any, chunk: Any, n_past: Any, sequence: Any, n_batch: int, _last: bool, past: Any
    ) -> int:
        """Evaluate a slice in the vision tower, then in the language model, and wait for each."""
        started_ns = now_ns()
        failed: int = mtmd_cpp.mtmd_encode_chunk(mtmd, chunk)
        self.encode_ns += now_ns() - started_ns
        if failed:
            return failed
        embedding = mtmd_cpp.mtmd_get_output_embd(mtmd)
        failed = mtmd_cpp.mtmd_helper_decode_image_chunk(
            mtmd, llama, chunk, embedding, n_past, sequence, n_batch, past, _NO_CALLBACK, None
        )
        llama_cpp.llama_synchronize(llama)
        return failed


class PixelHandler(chat_format.MiniCPMv26ChatHandler):  # type: ignore[misc, name-defined]  # the library has no types
    """The library's handler, except that a picture is an RGB array and not the bytes of a JPEG."""

    def __init__(self, mmproj: str, *, use_gpu: bool) -> None:
        super().__init__(clip_model_path=mmproj, verbose=False)
        self._mtmd_cpp = self.steps = Steps()
        self.mtmd_ctx: Any = None
        self.frames: tuple[Frame, ...] = ()
        self._use_gpu = use_gpu

    def _init_mtmd_context(self, llama_model: Any) -> None:
        """Load the vision tower; the library's version puts it on a GPU whatever the user chose."""
        if self.mtmd_ctx is not None:
            return
        mtmd = self._mtmd_cpp
        params = mtmd.mtmd_context_params_default()
        params.use_gpu = self._use_gpu
        params.print_timings = False
        params.n_threads = llama_model.n_threads
        params.flash_attn_type = llama_model.context_params.flash_attn_type
        self.mtmd_ctx = mtmd.mtmd_init_from_file(self.clip_model_path.encode(), llama_model.model, params)
        if self.mtmd_ctx is None:
            raise ValueError(llama_log.reason() or "MTMD cannot load it")
        llama_model._stack.callback(self._free)  # noqa: SLF001 as the library does

    def _free(self) -> None:
        self._mtmd_cpp.mtmd_free(self.mtmd_ctx)
        self.mtmd_ctx = None

    def load_image(self, image_url: str) -> Frame:
        return self.frames[int(image_url.rstrip("/").rpartition("/")[2])]

    def _create_bitmap_from_bytes(self, image_bytes: Frame) -> Any:
        pixels = np.ascontiguousarray(image_bytes.data)
        pointer = pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
        return self._mtmd_cpp.mtmd_bitmap_init(image_bytes.width, image_bytes.height, pointer)
