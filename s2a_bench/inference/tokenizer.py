"""A model's tokenizer, loaded from the GGUF file without the weights."""

from __future__ import annotations

import weakref
from pathlib import Path

from s2a_bench import extras
from s2a_bench.errors import ModelError
from s2a_bench.inference import llama_log
from s2a_bench.inference.gguf_file import read_header
from s2a_bench.inference.llama_decode import TokenBytes
from s2a_bench.inference.models import tiny_dummy

llama_cpp = extras.require("llama_cpp", "llama")


class Tokenizer:
    """Turns text into token ids; adds no tokens, and reads special tokens as text.

    The ids are those of text at the start of a line: some tokenizers (SentencePiece's) put a blank before other text.
    """

    def __init__(self, model: Path | None = None) -> None:
        """Load the vocabulary of a GGUF language model, of the tiny dummy if none is named; raises ModelError."""
        path = model or tiny_dummy()[0]
        header = read_header(path, "`model`")
        if header.is_mmproj:
            raise ModelError(f"`model` {path}: this is an mmproj (vision tower); it has no tokenizer")
        llama_log.silence()
        llama_log.reason()
        params = llama_cpp.llama_model_default_params()
        params.vocab_only = True
        self._model = llama_cpp.llama_model_load_from_file(str(path).encode(), params)
        if not self._model:
            raise ModelError(f"`model` {path}: llama.cpp: {llama_log.reason() or 'cannot read its vocabulary'}")
        weakref.finalize(self, llama_cpp.llama_model_free, self._model)
        self._vocab = llama_cpp.llama_model_get_vocab(self._model)
        self.size = int(llama_cpp.llama_vocab_n_tokens(self._vocab))
        self.name = str(header.fields.get("general.name", path.name))
        """The model's name in the file."""
        self._pieces = TokenBytes(self._vocab)
        self._newline = self._tokenize("\n")

    def __call__(self, text: str) -> list[int]:
        ids = self._tokenize(f"\n{text}")
        start = len(self._newline)
        return ids[start:] if ids[:start] == self._newline else self._tokenize(text)

    def _tokenize(self, text: str) -> list[int]:
        data = text.encode()
        most = len(data) + 1  # a token has a byte or more, and some tokenizers put a blank in front
        ids = (llama_cpp.llama_token * most)()
        count = llama_cpp.llama_tokenize(self._vocab, data, len(data), ids, most, False, False)
        if count < 0:
            raise ModelError(f"{self.name}: llama.cpp needs {-count} tokens for {len(data)} bytes")
        return list(ids[:count])

    def piece(self, token: int) -> bytes:
        return self._pieces[token]
