"""A model's prompt: its chat template, rendered as llama.cpp's server does, and its evaluation with RGB pictures."""

from __future__ import annotations

import ctypes
from contextlib import ExitStack
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
            prompt = self._rendered([{"type": "text", "text": _PROBE}])
        except Exception:  # noqa: BLE001 - MiniCPM's adds a list to a text
            return False
        return _PROBE in prompt and "'text'" not in prompt


def evaluate_text(llama: Any, prompt: str, _frames: tuple[Frame, ...], room: int) -> tuple[int, int]:
    """Evaluate a prompt of up to ``room`` tokens on an empty KV cache, without its pictures; raises TooLong.

    Return when it was tokenised, and 0, the time of the pictures.
    """
    tokens = llama.tokenize(prompt.encode(), add_bos=True, special=True)
    if len(tokens) > room:
        raise TooLong(len(tokens))
    prepared_ns = now_ns()
    llama.restart()
    llama.eval(tokens)
    return prepared_ns, 0


class VisionTower:
    """A loaded mmproj, which evaluates prompts with pictures as llama-cpp-python's handler does, but timed in steps."""

    def __init__(self, llama: Any, mmproj: str, *, use_gpu: bool) -> None:
        """Load it with the language model's kind of flash attention; raises ValueError."""
        params = mtmd_cpp.mtmd_context_params_default()
        params.use_gpu = use_gpu
        params.print_timings = False
        params.n_threads = llama.n_threads
        params.flash_attn_type = llama.context_params.flash_attn_type
        self._mtmd = mtmd_cpp.mtmd_init_from_file(mmproj.encode(), llama.model, params)
        if self._mtmd is None:
            raise ValueError(llama_log.reason() or "MTMD cannot load it")
        llama._stack.callback(mtmd_cpp.mtmd_free, self._mtmd)  # noqa: SLF001 - as the library does

    def evaluate(self, llama: Any, prompt: str, frames: tuple[Frame, ...], room: int) -> tuple[int, int]:
        """Evaluate a prompt with markers, of up to ``room`` tokens, on an empty KV cache; raises TooLong.

        Where a picture's tokens share positions (M-RoPE) they are more than its positions. Return when the prompt was
        tokenised and its pictures sliced, and the tower's time for these, in ns.
        """
        data = prompt.encode()
        text = mtmd_cpp.mtmd_input_text(text=data, text_len=len(data), add_special=True, parse_special=True)
        with ExitStack() as stack:
            bitmaps = (mtmd_cpp.mtmd_bitmap_p_ctypes * len(frames))()
            for place, frame in enumerate(frames):
                bitmaps[place] = bitmap_of(frame)
                stack.callback(mtmd_cpp.mtmd_bitmap_free, bitmaps[place])
            chunks = mtmd_cpp.mtmd_input_chunks_init()
            stack.callback(mtmd_cpp.mtmd_input_chunks_free, chunks)
            if code := mtmd_cpp.mtmd_tokenize(self._mtmd, chunks, ctypes.byref(text), bitmaps, len(frames)):
                raise ValueError(f"Failed to tokenize input: error code {code}")
            if (count := mtmd_cpp.mtmd_helper_get_n_tokens(chunks)) > room:
                raise TooLong(count)
            prepared_ns, encode_ns = now_ns(), 0
            llama.restart()
            for place in range(mtmd_cpp.mtmd_input_chunks_size(chunks)):
                chunk = mtmd_cpp.mtmd_input_chunks_get(chunks, place)
                if mtmd_cpp.mtmd_input_chunk_get_type(chunk) == mtmd_cpp.MTMD_INPUT_CHUNK_TYPE_TEXT:
                    size = ctypes.c_size_t()
                    tokens = mtmd_cpp.mtmd_input_chunk_get_tokens_text(chunk, ctypes.byref(size))
                    llama.eval(tokens[: size.value])
                else:
                    encode_ns += self._evaluate_slice(llama, chunk)
        return prepared_ns, encode_ns

    def _evaluate_slice(self, llama: Any, chunk: Any) -> int:
        """Evaluate a slice here, then in the language model, and wait for each; return the time of the former in ns."""
        started_ns, past = now_ns(), llama.n_tokens
        code = mtmd_cpp.mtmd_encode_chunk(self._mtmd, chunk)
        encode_ns, reached = now_ns() - started_ns, llama_cpp.llama_pos(0)
        if not code:
            embedding = mtmd_cpp.mtmd_get_output_embd(self._mtmd)
            # the helper also decodes non-causally where the model wants that for pictures (Gemma 3)
            decode, end = mtmd_cpp.mtmd_helper_decode_image_chunk, ctypes.byref(reached)
            code = decode(self._mtmd, llama.ctx, chunk, embedding, past, 0, llama.n_batch, end, _NO_CALLBACK, None)
            llama_cpp.llama_synchronize(llama.ctx)
        if code:
            raise ValueError(f"Failed to evaluate chunk: error code {code}")
        llama.n_tokens = reached.value  # the library counts positions as tokens; with M-RoPE there are fewer
        return encode_ns


def bitmap_of(frame: Frame) -> Any:
    pixels = np.ascontiguousarray(frame.data)
    pointer = pixels.ctypes.data_as(ctypes.POINTER(ctypes.c_uint8))
    return mtmd_cpp.mtmd_bitmap_init(frame.width, frame.height, pointer)
