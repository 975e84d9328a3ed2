"""GBNF grammars as llama-server applies them: checked first, then consulted token by token.

llama-cpp-python puts a grammar at the head of its chain of samplers, where it judges every token of the vocabulary:
9 ms a token with Qwen2's 151666 on the machine this was written on. llama.cpp's own programs ask it about the token
that was sampled, and about the whole vocabulary only where it refuses that one (``common/sampling.cpp``); so does this.
"""

from __future__ import annotations

import ctypes
import math
import os
import re
import tempfile
import weakref
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.inference import llama_log

llama_cpp = extras.require("llama_cpp", "llama")

_STDERR = 2


class GrammarSampler:
    """Stands in for the library's `LlamaSampler` where a request has a grammar."""

    def __init__(self, chain: Any, vocab: Any, grammar: str, candidates: Any) -> None:
        """Sample from ``chain``, a sampler without grammar; ``candidates`` is scratch space for the vocabulary."""
        self._chain = chain
        self._grammar = llama_cpp.llama_sampler_init_grammar(vocab, grammar.encode(), b"root")
        self._candidates = candidates
        weakref.finalize(self, llama_cpp.llama_sampler_free, self._grammar)

    def sample(self, ctx: Any, idx: int = -1) -> int:
        """Return a token that the grammar allows, and move the grammar on."""
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
    """Return what is wrong with a GBNF grammar, "" if nothing is.

    llama.cpp's parser writes to stderr directly, so that is redirected for the moment, for the whole process.
    """
    llama_log.reason()
    with tempfile.TemporaryFile() as file:
        saved = os.dup(_STDERR)
        os.dup2(file.fileno(), _STDERR)
        try:
            sampler = llama_cpp.llama_sampler_init_grammar(vocab, grammar.encode(), b"root")
        finally:
            os.dup2(saved, _STDERR)
            os.close(saved)
        file.seek(0)
        said = file.read().decode(errors="replace").strip().splitlines()
    if sampler:
        llama_cpp.llama_sampler_free(sampler)
        return ""
    logged = llama_log.reason()
    return re.sub(r"^[a-z_]+: (error parsing grammar: )?", "", said[0]) if said else logged or "llama.cpp refuses it"
