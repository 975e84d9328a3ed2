"""The loop that writes an answer token by token, with little between two calls of ``llama_decode``.

llama-cpp-python's own loop (``Llama.generate``) trims the KV cache, fills a batch and copies tokens for every one; with
a small model that is a tenth of the time.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from s2a_bench import extras

llama_cpp = extras.require("llama_cpp", "llama")
bindings = llama_cpp.llama_cpp

_logits_address = bindings._lib["llama_get_logits_ith"]  # noqa: SLF001 a function object of our own: a plain address
_logits_address.argtypes = [ctypes.c_void_p, ctypes.c_int32]
_logits_address.restype = ctypes.c_void_p


_PIECE_BYTES = 1024


class TokenBytes(dict[int, bytes]):
    """The bytes of each token written so far; the library's `detokenize` cuts at 32. Special tokens have none."""

    def __init__(self, vocab: Any) -> None:
        """Look tokens up in llama.cpp's ``vocab``, which must live as long."""
        self._vocab = vocab
        self._piece = ctypes.create_string_buffer(_PIECE_BYTES)

    def __missing__(self, token: int) -> bytes:
        """Ask llama.cpp, once a token."""
        size = llama_cpp.llama_token_to_piece(self._vocab, token, self._piece, _PIECE_BYTES, 0, False)
        self[token] = found = self._piece.raw[: max(0, size)]
        return found


class Sampler(Protocol):
    """Chooses a token; llama-cpp-python's ``LlamaSampler`` is one."""

    def sample(self, ctx: Any, idx: int = -1) -> int:
        """Return the token that follows output ``idx`` of the library's context."""
        ...


class GreedySampler:
    """Takes the likeliest token, the first of equals, from the logits where they lie.

    llama.cpp's greedy sampler gives the same, after it has written the vocabulary down as candidates: 160 us against
    10 with Qwen2's 151666 on the machine this was written on.
    """

    def __init__(self, n_vocab: int) -> None:
        """Sample from ``n_vocab`` logits."""
        self._n_vocab = n_vocab
        self._address = 0
        self._logits: NDArray[np.float32] = np.zeros(0, np.float32)

    def sample(self, ctx: Any, idx: int = -1) -> int:
        """Return the index of the largest logit; waits for the device to have computed it."""
        address = _logits_address(ctx.ctx, idx)
        if address != self._address:  # llama.cpp moves its buffer only when it needs a larger one
            if not address:
                raise RuntimeError("there are no logits")
            self._logits = np.ctypeslib.as_array((ctypes.c_float * self._n_vocab).from_address(address))
            self._address = address
        return int(self._logits.argmax())


class TokenBatch:
    """A batch of one token of sequence 0, allocated once."""

    def __init__(self) -> None:
        """Allocate; `close` frees."""
        self._batch = llama_cpp.llama_batch_init(1, 0, 1)
        self._batch.n_tokens = 1
        self._batch.n_seq_id[0] = 1
        self._batch.seq_id[0][0] = 0
        self._batch.logits[0] = 1

    def answer(self, ctx: Any, sampler: Sampler, position: int) -> Iterator[int]:
        """Yield tokens for ever, the first from the logits that are there; ``position`` is the prompt's length.

        Raises RuntimeError where llama.cpp cannot decode.
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

    def close(self) -> None:
        """Free the batch; may be called twice."""
        if self._batch is not None:
            llama_cpp.llama_batch_free(self._batch)
            self._batch = None
