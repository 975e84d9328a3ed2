"""A model's prompt: its chat template, rendered as llama.cpp's own server does, and its evaluation.

Pictures are RGB pixels, which llama-cpp-python's handler takes for any of its models.
"""

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

MARKER = mtmd_cpp.mtmd_default_marker().decode()
"""The text that stands for a picture."""

_PROBE = "s2a-bench"
_NO_CALLBACK = mtmd_cpp.mtmd_helper_post_decode_callback()


class TooLong(Exception):
    """A prompt of so many tokens leaves no room for its answer; raised before it is evaluated."""


class ChatTemplate:
    """A Jinja template of a file or a user; most take a message's content as a list of parts, some as one text."""

    def __init__(self, source: str, vocab: Any) -> None:
        """Compile the template; raises ValueError if it cannot render a message."""
        ids = llama_cpp.llama_vocab_bos(vocab), llama_cpp.llama_vocab_eos(vocab)
        bos, eos = (llama_cpp.llama_vocab_get_text(vocab, token).decode() if token >= 0 else "" for token in ids)
        self._added = bos if llama_cpp.llama_vocab_get_add_bos(vocab) else ""  # the tokenizer adds it, too
        try:
            self._formatter = chat_format.Jinja2ChatFormatter(source, eos_token=eos, bos_token=bos)
            self._takes_parts = self._reads_parts()
            if MARKER + _PROBE not in self.prompt(_PROBE, 1):
                raise ValueError("it does not render the message")
        except Exception as error:  # a template may do anything
            raise ValueError(f"{type(error).__name__}: {error}") from error

    def prompt(self, text: str, pictures: int) -> str:
        """Return the prompt of a user's message: a marker for each of so many pictures, then a text."""
        whole = MARKER * pictures + text
        return self._rendered([{"type": "text", "text": whole}] if self._takes_parts else whole)

    def _rendered(self, content: Any) -> str:
        messages = [{"role": "user", "content": content}]
        prompt: str = self._formatter(messages=messages, enable_thinking=True).prompt
        return prompt.removeprefix(self._added)

    def _reads_parts(self) -> bool:
        try:
            found = self._rendered([{"type": "text", "text": _PROBE}])
        except Exception:  # noqa: BLE001 - MiniCPM's adds a list to a text
            return False
        return _PROBE in found and "'text'" not in found


class TextHandler:
    """Evaluates prompts of a model without a vision tower, which does not see a request's pictures."""

    def load(self, llama: Any) -> None:
        """Load nothing more."""

    def evaluate(self, llama: Any, prompt: str, _frames: tuple[Frame, ...], room: int) -> tuple[int, int]:
        """Evaluate a prompt of up to ``room`` tokens on an empty KV cache; raises TooLong.

        Return when it was tokenised, and 0, the time of the pictures that it has not.
        """
        tokens = llama.tokenize(prompt.encode(), add_bos=True, special=True)
        if len(tokens) > room:
            raise TooLong(len(tokens))
        prepared_ns = now_ns()
        llama.reset()
        llama._ctx.kv_cache_clear()  # noqa: SLF001 - as the library does
        llama.eval(tokens)
        llama.prompt = tokens
        return prepared_ns, 0


class Steps:
    """MTMD's bindings, except that a call of the library's handler is split into steps, each timed.

    ``prepared_ns`` is the time at which the last prompt was tokenised and its pictures sliced; ``encode_ns`` is the
    vision tower's time for them so far; ``room`` is the most tokens of a prompt, which are more than its positions
    where a picture's share them (M-RoPE).
    """

    def __init__(self) -> None:
        self.prepared_ns = 0
        self.encode_ns = 0
        self.room = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(mtmd_cpp, name)

    def mtmd_tokenize(self, mtmd: Any, chunks: Any, *arguments: Any) -> int:
        failed: int = mtmd_cpp.mtmd_tokenize(mtmd, chunks, *arguments)
        if not failed and (count := mtmd_cpp.mtmd_helper_get_n_tokens(chunks)) > self.room:
            raise TooLong(count)
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


class PixelHandler(chat_format.MTMDChatHandler):  # type: ignore[misc, name-defined]  # the library has no types
    """The library's handler, except that a picture is an RGB array, and that the prompt is rendered already."""

    def __init__(self, mmproj: str, *, use_gpu: bool) -> None:
        super().__init__(clip_model_path=mmproj, verbose=False, use_gpu=use_gpu)
        self._mtmd_cpp = self.steps = Steps()
        self._prompt = ""
        self._frames: tuple[Frame, ...] = ()
        self.mtmd_ctx: Any = None

    def evaluate(self, llama: Any, prompt: str, frames: tuple[Frame, ...], room: int) -> tuple[int, int]:
        """Evaluate a prompt with markers, of up to ``room`` tokens, on an empty KV cache; raises TooLong.

        Return ``prepared_ns`` and ``encode_ns`` of its `Steps`.
        """
        self._prompt, self._frames, self.steps.room = prompt, frames, room
        pictures = [{"type": "image_url", "image_url": str(place)} for place in range(len(frames))]
        try:
            self(llama=llama, messages=[{"role": "user", "content": pictures}], stream=True)
        finally:
            self._frames = ()
        return self.steps.prepared_ns, self.steps.encode_ns

    def load(self, llama: Any) -> None:
        """Load the vision tower; raises ValueError."""
        self._init_mtmd_context(llama)

    def _get_chat_template(self, _llama: Any) -> str:
        return "{{ messages }}"

    def _get_template_messages(self, _messages: Any, _marker: str) -> str:
        return self._prompt

    def _postprocess_template_text(self, text: str, _urls: Any, _marker: str) -> str:
        return text

    def _init_mtmd_context(self, llama_model: Any) -> None:
        """Load with the language model's kind of flash attention; the library turns llama.cpp's own choice off."""
        if self.mtmd_ctx is not None:
            return
        mtmd = self._mtmd_cpp
        params = mtmd.mtmd_context_params_default()
        params.use_gpu = self.use_gpu
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
        return self._frames[int(image_url)]

    def _create_bitmap_from_bytes(self, image_bytes: Frame) -> Any:
        pixels = np.ascontiguousarray(image_bytes.data)
        pointer = pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
        return self._mtmd_cpp.mtmd_bitmap_init(image_bytes.width, image_bytes.height, pointer)
