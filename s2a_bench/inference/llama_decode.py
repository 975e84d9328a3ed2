"""Decode an answer token by token, with little work between two calls of ``llama_decode``; and check its grammar.

llama-cpp-python's loop (``Llama.generate``) trims the KV cache, fills a batch and copies tokens for every one; with a
small model that is a tenth of the time.
"""

from __future__ import annotations

import ctypes
import math
import os
import re
import tempfile
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.inference import llama_log

llama_cpp = extras.require("llama_cpp", "llama")
bindings = llama_cpp.llama_cpp

_PIECE_BYTES = 1024
_STDERR = 2
GRAMMAR_BYTES = 1 << 20
DEPTH = 200
"""Limit of nested parentheses."""
RULES = 5_000
"""llama.cpp also recurses along rules that name each other."""
REPETITIONS = 10_000
"""Limit of nested braces, multiplied: llama.cpp expands repetitions."""

_DIGITS = 6
_LEXEME = re.compile(r'"(?:\\.|[^"\\])*"?|\[(?:\\.|[^\]\\])*\]?|#[^\n]*|\{([^}]*)\}?|[()]', re.DOTALL)
"""An open text or bracket extends to the end, so that nothing is read twice."""


class TokenBytes(dict[int, bytes]):
    """The bytes of each token; the library's `detokenize` truncates at 32. Special tokens have none.

    llama.cpp's ``vocab`` must live as long.
    """

    def __init__(self, vocab: Any) -> None:
        self._vocab = vocab
        self._piece = ctypes.create_string_buffer(_PIECE_BYTES)

    def __missing__(self, token: int) -> bytes:
        size = llama_cpp.llama_token_to_piece(self._vocab, token, self._piece, _PIECE_BYTES, 0, False)
        self[token] = piece = self._piece.raw[: max(0, size)]
        return piece


class TokenBatch:
    """A batch of one token of sequence 0, allocated once."""

    def __init__(self) -> None:
        self._batch = llama_cpp.llama_batch_init(1, 0, 1)
        weakref.finalize(self, llama_cpp.llama_batch_free, self._batch)
        self._batch.n_tokens = 1
        self._batch.n_seq_id[0] = 1
        self._batch.seq_id[0][0] = 0
        self._batch.logits[0] = 1

    def answer(self, ctx: Any, sampler: Any, position: int) -> Iterator[int]:
        """Yield tokens of the library's (or our) ``sampler`` without end; ``position`` is the prompt's length.

        Raises RuntimeError if llama.cpp cannot decode.
        """
        batch, handle = self._batch, ctx.ctx
        tokens, positions, decode = batch.token, batch.pos, bindings.llama_decode
        while True:
            token = sampler.sample(ctx, -1)
            yield token
            tokens[0] = token
            positions[0] = position
            if code := decode(handle, batch):
                raise RuntimeError(f"llama_decode returned {code}")
            position += 1


class GrammarSampler:
    """Samples from ``chain``, the library's `LlamaSampler`, under a grammar, as llama-server does.

    It checks the sampled token first, and all tokens only if the grammar refuses that one (``common/sampling.cpp``);
    llama-cpp-python checks every token of the vocabulary: 9 ms a token with Qwen2's 151666 on the development machine.
    """

    def __init__(self, chain: Any, vocab: Any, grammar: str, candidates: Any) -> None:
        self._chain = chain
        self._grammar = llama_cpp.llama_sampler_init_grammar(vocab, grammar.encode(), b"root")
        self._candidates = candidates
        weakref.finalize(self, llama_cpp.llama_sampler_free, self._grammar)

    def sample(self, ctx: Any, idx: int = -1) -> int:
        token = self._chain.sample(ctx, idx)
        if not self._allows(token):
            token = self._among_allowed(ctx, idx)
        llama_cpp.llama_sampler_accept(self._grammar, token)
        return int(token)

    def _allows(self, token: int) -> bool:
        data = (llama_cpp.llama_token_data * 1)(llama_cpp.llama_token_data(id=token, logit=1.0, p=0.0))
        array = llama_cpp.llama_token_data_array(data=data, size=1, selected=-1, sorted=False)
        llama_cpp.llama_sampler_apply(self._grammar, ctypes.byref(array))
        return not math.isinf(data[0].logit)

    def _among_allowed(self, ctx: Any, idx: int) -> int:
        logits = llama_cpp.llama_get_logits_ith(ctx.ctx, idx)
        self._candidates.copy_logits(np.ctypeslib.as_array(logits, (self._candidates.n_vocab,)))
        array = self._candidates.candidates
        array.selected = -1
        llama_cpp.llama_sampler_apply(self._grammar, ctypes.byref(array))
        llama_cpp.llama_sampler_apply(self._chain.sampler, ctypes.byref(array))
        return int(array.data[array.selected].id)


def grammar_error(vocab: Any, grammar: str) -> str:
    """Return the error of a GBNF grammar, or "".

    llama.cpp's parser writes to stderr, which is therefore redirected meanwhile, for the whole process.
    """
    llama_log.reason()  # forgets earlier errors
    with tempfile.TemporaryFile() as file:
        saved = os.dup(_STDERR)
        os.dup2(file.fileno(), _STDERR)
        try:
            sampler = llama_cpp.llama_sampler_init_grammar(vocab, grammar.encode(), b"root")
        finally:
            os.dup2(saved, _STDERR)
            os.close(saved)
        file.seek(0)
        lines = file.read().decode(errors="replace").strip().splitlines()
    if sampler:
        llama_cpp.llama_sampler_free(sampler)
        return ""
    logged = llama_log.reason()
    return re.sub(r"^[a-z_]+: (error parsing grammar: )?", "", lines[0]) if lines else logged or "llama.cpp refuses it"


def beyond_limits(grammar: str) -> str:
    """Return the limit beyond which a grammar would crash llama.cpp's recursive parser, or ""."""
    if len(grammar) > GRAMMAR_BYTES or len(grammar.encode(errors="replace")) > GRAMMAR_BYTES:
        return f"it is longer than {GRAMMAR_BYTES} bytes"
    if "\0" in grammar:
        return "it has a NUL"
    if grammar.count("::=") > RULES:
        return f"it has more than {RULES} rules"
    repeated, last = [1], 1  # the most repetitions in each open parenthesis, and those of the last lexeme
    for lexeme in _LEXEME.finditer(grammar):
        text, times = lexeme[0], 1
        if text == "(":
            repeated.append(1)
        elif text == ")" and len(repeated) > 1:
            times = repeated.pop()
        elif lexeme[1] is not None:
            times = last * _most(lexeme[1])
        last = times
        repeated[-1] = max(repeated[-1], times)
        if len(repeated) > DEPTH + 1:
            return f"it nests deeper than {DEPTH} parentheses"
        if times > REPETITIONS:
            return f"it repeats something more than {REPETITIONS} times"
    return ""


def _most(braces: str) -> int:
    numbers = re.findall(r"\d+", braces)
    return max([1, *(int(digits) if len(digits) <= _DIGITS else REPETITIONS + 1 for digits in numbers)])
