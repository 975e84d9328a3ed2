"""A model's prompt: its chat template, rendered as llama.cpp's own server does, and its evaluation without pictures."""

from __future__ import annotations

from typing import Any

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.types import Frame

llama_cpp = extras.require("llama_cpp", "llama")
chat_format = extras.require("llama_cpp.llama_chat_format", "llama")
mtmd_cpp = extras.require("llama_cpp.mtmd_cpp", "llama")

MARKER = mtmd_cpp.mtmd_default_marker().decode()
"""The text that stands for a picture."""

_PROBE = "s2a-bench"


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
