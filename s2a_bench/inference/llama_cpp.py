"""llama.cpp as an engine: any model that it runs, with RGB pixels as input, token by token."""

from __future__ import annotations

import codecs
import ctypes
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version
from typing import Any

import numpy as np

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.errors import BadRequest, EngineError, ModelError, UsageError
from s2a_bench.facts import (
    FIRST_DECODE_MS,
    PREDICTED_MS,
    PREDICTED_N,
    PREPROCESS_MS,
    PROMPT_EVAL_MS,
    PROMPT_MS,
    PROMPT_N,
    VISION_ENCODE_MS,
)
from s2a_bench.inference import (
    FLASH_ATTENTION,
    KV_TYPES,
    LAST_N,
    PENALTY_LAST_N,
    SAMPLER_ARGUMENTS,
    SAMPLINGS,
    Engine,
    EngineConfig,
    llama_log,
)
from s2a_bench.inference.llama_decode import GrammarSampler, TokenBatch, TokenBytes, beyond_limits, grammar_error
from s2a_bench.inference.llama_prompt import ChatTemplate, TooLong, VisionTower, evaluate_text
from s2a_bench.inference.models import load_headers
from s2a_bench.types import Frame, Request, Token

llama_cpp = extras.require("llama_cpp", "llama")

_MS_NS = 1_000_000
_DESCRIBED = ("gpu_layers", "context", "batch", "kv_type", "flash_attention", "sampling")
_GRAMMARS = 64
"""Limit on cached results of checks: a grammar can be a MiB."""


class _Prefilled(llama_cpp.Llama):  # type: ignore[misc, name-defined]  # the library has no types
    """A Llama that leaves the generation of tokens to `TokenBatch`."""

    def __init__(self, model: str, *, flash_attention: int, **settings: Any) -> None:
        self._flash_attention = flash_attention
        super().__init__(model, **settings)

    @property
    def context_params(self) -> Any:
        """The library's settings for llama.cpp with this type of flash attention; it knows on and off only."""
        self._context_params.flash_attn_type = self._flash_attention
        return self._context_params

    @context_params.setter
    def context_params(self, params: Any) -> None:
        self._context_params = params

    def sampler(self, name: str, grammar: str, settings: Mapping[str, float]) -> Any:
        """Build the sampling ``name``, with some ``settings`` replaced, as a chain of samplers under a grammar."""
        last_n = int(settings.get(PENALTY_LAST_N, LAST_N))
        self.last_n_tokens_size = self.n_ctx() if last_n < 0 else last_n  # -1 is llama.cpp's "all of the context"
        arguments = {SAMPLER_ARGUMENTS[key]: value for key, value in settings.items() if key in SAMPLER_ARGUMENTS}
        chain = self._init_sampler(**SAMPLINGS[name] | arguments)
        return GrammarSampler(chain, self._model.vocab, grammar, self._candidates) if grammar else chain

    def eval(self, tokens: list[int]) -> None:
        """Evaluate, and wait: a GPU's queue would else count as the vision tower's time, or the reverse."""
        super().eval(tokens)
        llama_cpp.llama_synchronize(self.ctx)

    def restart(self) -> None:
        self.reset()
        self._ctx.kv_cache_clear()


@contextmanager
def _refused(what: str, llama: _Prefilled) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        llama.close()
        raise ModelError(f"{what}: {error}") from error


class LlamaCppEngine(Engine):
    """A GGUF model on this machine. ``facts`` holds numbers of the last request, under llama-server's names.

    An answer ends before the next request, and before `close`, as `OneThreadEngine` sees to.
    """

    def __init__(self, config: EngineConfig) -> None:
        """Load both files; raises UsageError for layers on a GPU that this build cannot use, ModelError."""
        if config.gpu_layers and not llama_cpp.llama_supports_gpu_offload():
            raise UsageError(
                "`gpu_layers`: this llama-cpp-python is built for the CPU alone; "
                "build it for the GPU ('s2a-bench doctor' says how), or leave it out"
            )
        self._files = load_headers(config)
        self._config = config
        self._threads = config.threads or len(os.sched_getaffinity(0))
        llama_log.silence()
        llama_log.reason()  # forgets what another model logged
        self._llama: _Prefilled | None = self._load()
        self._batch = TokenBatch()

    def _load(self) -> _Prefilled:
        config, files, kv_type = self._config, self._files, KV_TYPES[self._config.kv_type]
        try:
            llama = _Prefilled(
                str(files.model.path),
                n_ctx=config.context,
                n_batch=config.batch,
                n_ubatch=config.batch,
                type_k=kv_type,
                type_v=kv_type,
                flash_attention=FLASH_ATTENTION[config.flash_attention],
                n_gpu_layers=config.gpu_layers,
                n_threads=self._threads,
                n_threads_batch=self._threads,
                verbose=llama_log.verbose(),
            )
        except (ValueError, RuntimeError, OSError) as error:
            raise ModelError(f"`model` {files.model.path}: llama.cpp: {llama_log.reason() or error}") from error
        llama_log.silence()  # the library sets its own log level while it loads
        vocab = llama._model.vocab  # noqa: SLF001
        self._pieces = TokenBytes(vocab)
        check = lru_cache(_GRAMMARS)  # a request's grammar rarely changes
        self._grammar_error = check(lambda grammar: beyond_limits(grammar) or grammar_error(vocab, grammar))
        self._prefill: Callable[[Any, str, tuple[Frame, ...], int], tuple[int, int]] = evaluate_text
        if files.mmproj:
            path = str(files.mmproj.path)
            with _refused(f"`mmproj` {path}: llama.cpp", llama):
                self._prefill = VisionTower(llama, path, use_gpu=config.gpu_layers != 0).evaluate
        with _refused(f"`chat_template` {config.chat_template or files.model.path}", llama):
            self._template = ChatTemplate(files.chat_template, vocab)
        return llama

    def generate(self, request: Request) -> Iterator[Token]:
        """Yield one `Token` per token of the model; the last token of a character carries all its bytes.

        Raises BadRequest for a bad grammar, pictures that are not ``rgb8``, and a request longer than the context.
        """
        llama = self._llama
        if llama is None:
            raise EngineError("llama: the engine is closed; open a new one")
        self._check(request)
        started = now_ns()
        prepared_ns, encode_ns = self._evaluate(llama, request)
        prompt_done = now_ns()
        perf = llama_cpp.llama_perf_context(llama.ctx)
        self._facts = {
            PROMPT_N: float(perf.n_p_eval),
            PROMPT_MS: (prompt_done - started) / _MS_NS,
            PREPROCESS_MS: (prepared_ns - started) / _MS_NS,
            PROMPT_EVAL_MS: perf.t_p_eval_ms,
            PREDICTED_N: 0.0,
            PREDICTED_MS: 0.0,
        }
        if request.images and self._files.mmproj:
            self._facts[VISION_ENCODE_MS] = encode_ns / _MS_NS
        ignore_end = self._files.dummy and not request.grammar  # random weights end at random, counts should not
        decode = codecs.getincrementaldecoder("utf-8")("replace").decode
        llama.set_seed(request.seed & 0x7FFF_FFFF)  # 2**32-1 would mean a random seed
        sampler = llama.sampler(self._config.sampling, request.grammar, dict(request.sampling))
        ids = self._batch.answer(llama._ctx, sampler, llama.n_tokens)  # noqa: SLF001
        count, last_ns, pieces = 0, prompt_done, self._pieces
        try:
            for index in range(request.max_tokens):
                started_ns = now_ns()
                token = next(ids)
                if index == 1:  # the first token is sampled from the prompt's logits, without a decode
                    self._facts[FIRST_DECODE_MS] = (now_ns() - started_ns) / _MS_NS
                if not ignore_end and llama_cpp.llama_vocab_is_eog(llama._model.vocab, token):  # noqa: SLF001
                    return
                text = decode(pieces[token], index + 1 == request.max_tokens)
                count, last_ns = index + 1, now_ns()
                yield Token(index, text, token)
        except RuntimeError as error:
            raise EngineError(f"llama: generation failed: {llama_log.reason() or error}") from error
        finally:
            self._facts[PREDICTED_N] = float(count)
            self._facts[PREDICTED_MS] = (last_ns - prompt_done) / _MS_NS

    def _evaluate(self, llama: _Prefilled, request: Request) -> tuple[int, int]:
        """Evaluate pictures and prompt, on an empty KV cache, up to the first token's logits; return its times."""
        prompt = self._template.prompt(request.prompt, len(request.images) if self._files.mmproj else 0)
        llama_log.reason()  # forgets what an earlier request logged
        llama_cpp.llama_perf_context_reset(llama.ctx)
        try:
            times = self._prefill(llama, prompt, request.images, llama.n_ctx() - request.max_tokens)
        except TooLong as error:
            raise BadRequest(
                f"llama: request {request.id} does not fit the context of {llama.n_ctx()} tokens (prompt of {error} "
                f"tokens, answer of up to {request.max_tokens}); shorten it or raise --context"
            ) from error
        except (ValueError, RuntimeError) as error:
            raise EngineError(f"llama: request {request.id} was refused: {llama_log.reason() or error}") from error
        if not llama.n_tokens:
            raise BadRequest(f"llama: request {request.id} has a prompt without a token; write one")
        return times

    def _check(self, request: Request) -> None:
        """Refuse requests that would crash llama.cpp: pictures of another size than declared, damaged grammars."""
        for frame in request.images:
            if frame.encoding != "rgb8":
                raise BadRequest(f"llama: request {request.id} has a {frame.encoding} picture; engines take rgb8")
            if frame.data.shape != (frame.height, frame.width, 3) or frame.data.dtype != np.uint8:
                raise BadRequest(
                    f"llama: request {request.id} has a picture of {frame.width}x{frame.height} whose data are "
                    f"{frame.data.dtype} of shape {frame.data.shape}"
                )
        if request.grammar and (wrong := self._grammar_error(request.grammar)):
            raise BadRequest(f"llama: the grammar of request {request.id} is not valid GBNF: {wrong}")

    def describe(self) -> dict[str, str | int | float | bool]:
        """Describe the model; the first call hashes the files, which takes seconds for gigabytes."""
        seen = {"pictures": "not seen"}
        if self._files.mmproj:
            fields = self._files.mmproj.fields
            seen = {"projector": str(fields.get("clip.projector_type") or fields.get("clip.vision.projector_type", ""))}
        facts: dict[str, str | int | float | bool] = {
            "engine": "llama",
            **self._files.describe(),
            "architecture": self._files.model.architecture,
            **seen,
            "chat_template_sha256": hashlib.sha256(self._files.chat_template.encode()).hexdigest(),
            "llama_cpp_python": version("llama-cpp-python"),
            "threads": self._threads,
            "gpu_offload_supported": bool(llama_cpp.llama_supports_gpu_offload()),
            **{name: getattr(self._config, name) for name in _DESCRIBED},
        }
        if self._llama is not None:
            handle = self._llama.model
            facts["parameters"] = int(llama_cpp.llama_model_n_params(handle))
            facts["model_bytes"] = int(llama_cpp.llama_model_size(handle))
            description = ctypes.create_string_buffer(256)
            llama_cpp.llama_model_desc(handle, description, len(description))
            model_type = description.value.decode()
            facts["model_type"] = model_type
            facts["quantisation"] = model_type.split(maxsplit=2)[-1]  # of "qwen2 7B Q4_K - Medium"
        return facts

    def close(self) -> None:
        if self._llama is not None:
            self._llama.close()
            self._llama = None
