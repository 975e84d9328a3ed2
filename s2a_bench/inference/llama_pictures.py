"""Pictures on their way into llama.cpp: llama-cpp-python's MiniCPM-V 2.6 handler, given RGB pixels."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.inference import llama_log
from s2a_bench.types import Frame

chat_format = extras.require("llama_cpp.llama_chat_format", "llama")


class PixelHandler(chat_format.MiniCPMv26ChatHandler):  # type: ignore[misc, name-defined]  # the library has no types
    """The library's handler, except that a picture is an RGB array and not the bytes of a JPEG."""

    def __init__(self, mmproj: str, *, use_gpu: bool) -> None:
        """Prepare; the vision tower is loaded with the model that it belongs to."""
        super().__init__(clip_model_path=mmproj, verbose=False)
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
        llama_model._stack.callback(self._free)  # noqa: SLF001 the library's own way to tie the two together

    def _free(self) -> None:
        self._mtmd_cpp.mtmd_free(self.mtmd_ctx)
        self.mtmd_ctx = None

    def load_image(self, image_url: str) -> Frame:
        """Return the frame that the URL counts."""
        return self.frames[int(image_url.rstrip("/").rpartition("/")[2])]

    def _create_bitmap_from_bytes(self, image_bytes: Frame) -> Any:
        """Hand the pixels over; MTMD copies them."""
        pixels = np.ascontiguousarray(image_bytes.data)
        pointer = pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
        return self._mtmd_cpp.mtmd_bitmap_init(image_bytes.width, image_bytes.height, pointer)
