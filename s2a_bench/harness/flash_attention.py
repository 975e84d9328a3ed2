"""Flash attention ``auto``, decided by measuring: both ways answer in turn, once for a machine and model file.

llama.cpp's own ``auto`` takes flash attention wherever there is a kernel for it, also where that is the slower way.
Here the way wins that needs less time for a whole answer about a picture; what was seen is kept in the cache, and what
was seen on a busy machine is measured again on a quiet one.
``python -m s2a_bench.harness.flash_attention`` is told an engine in one JSON line and answers with one.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.errors import EngineError, S2AError
from s2a_bench.facts import PREDICTED_MS, PREDICTED_N, PROMPT_MS
from s2a_bench.harness.plan import DEFAULT_PROMPT
from s2a_bench.harness.processes import OwnProcess
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import cache_folder, sha256
from s2a_bench.machine import environment
from s2a_bench.machine.doctor import Machine
from s2a_bench.machine.doctor.cpu import load
from s2a_bench.machine.tuning import allowed, limit_threads

WAYS: Final = ("on", "off")
TOKENS: Final = 64
ROUNDS: Final = 5
ENOUGH_S: Final = 10.0
"""After so long no further round begins: a model that slow is not disturbed much either."""
CLEARLY: Final = 0.97
"""Flash attention, llama.cpp's own choice, stays unless the other way needs less than this part of its time."""
SETTINGS: Final = {"threads", "gpu_layers", "batch", "kv_type"}
"""What of an engine the answer depends on, its files apart."""
MACHINE: Final = ("machine", "cpu", "board", "cores", "affinity", "gpus", "power_mode")
"""What of the environment it depends on."""


def decided(
    engine: EngineConfig, say: Callable[[str], None], log: Path | None = None
) -> tuple[EngineConfig, dict[str, Any]]:
    """Return the engine with ``on`` or ``off`` for ``auto``, and what the manifest says of it.

    It stays ``auto`` where nothing can be measured, ``why`` tells, and where its files have not been found.
    """
    if engine.name != "llama" or engine.flash_attention != "auto" or None in {engine.model, engine.mmproj}:
        return engine, {}
    chosen, told = _decide(engine, say, log)
    return engine.but(flash_attention=chosen), {"flash_attention": {"asked": "auto", "chosen": chosen, **told}}


def _decide(engine: EngineConfig, say: Callable[[str], None], log: Path | None) -> tuple[str, dict[str, Any]]:
    """Return the way, and how it was found."""
    if engine.kv_type in {"q8_0", "q4_0"}:
        return "on", {"why": f"nothing else reads a KV cache of {engine.kv_type}"}
    if not extras.installed("llama_cpp"):
        return "auto", {"why": "llama-cpp-python is not installed, which would measure it"}
    note = cache_folder() / "flash-attention" / f"{_key(engine)}.json"
    busy = _busy()
    known = _read(note)
    if known is not None and (busy or not known["busy"]):
        return known["chosen"], {"cached": True, **known}
    say("flash attention on and off, measured once for this machine and model")
    try:
        best = _measured_apart(engine, log)
    except S2AError as error:  # the run itself will meet it again, and say more
        return "auto", {"why": str(error)}
    chosen = "off" if best["off"]["answer_ms"] < CLEARLY * best["on"]["answer_ms"] else "on"
    found = {"chosen": chosen, "measured": best, "tokens": TOKENS, "busy": busy}
    _write(note, found)
    return chosen, {"cached": False, **found}


def _busy() -> bool:
    """Whether the machine has so much else to do that the doctor warns."""
    found = load(Machine())
    return found is not None and found.level == "warning"


def _key(engine: EngineConfig) -> str:
    """Return a name for all that the answer depends on."""
    known = environment.collect()
    told = {
        "settings": engine.model_dump(mode="json", include=SETTINGS),
        "files": [sha256(path) for path in (engine.model, engine.mmproj) if path],
        "machine": {name: known.get(name) for name in MACHINE},
        "llama-cpp-python": known["packages"].get("llama-cpp-python"),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def _read(note: Path) -> dict[str, Any] | None:
    """Return what was found before; None where there is nothing, or what nobody wrote so."""
    try:
        found = json.loads(note.read_bytes()[:4096])
        return dict(found) if found["chosen"] in WAYS and found["busy"] in {True, False} else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write(note: Path, found: dict[str, Any]) -> None:
    """Keep it, in one step; a cache that cannot be written costs time, nothing else."""
    try:
        note.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=note.parent, delete=False) as file:
            json.dump(found, file)
        Path(file.name).replace(note)
    except OSError:
        return


def _measured_apart(engine: EngineConfig, log: Path | None) -> dict[str, dict[str, float]]:
    """Measure in a process of its own, whose threads and memory go with it."""
    with OwnProcess("flash attention", __name__, json.dumps(engine.model_dump(mode="json")), log) as child:
        child.wait_ready()
        return dict(child.facts["best"])


def measured(engine: EngineConfig) -> dict[str, dict[str, float]]:
    """Return way -> the shortest times in ms of a prompt with a picture, a token after it, and a whole answer."""
    _answer(engine, 1)  # the weights come from the disk
    seen: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    started = now_ns()
    for _ in range(ROUNDS):
        for way in WAYS:
            seen[way].append(_answer(engine.but(flash_attention=way), TOKENS))
        if now_ns() - started > ENOUGH_S * 1e9:
            break
    best = {}
    for way, times in seen.items():
        prompt_ms, token_ms = map(min, zip(*times, strict=True))
        best[way] = {"prompt_ms": prompt_ms, "token_ms": token_ms, "answer_ms": prompt_ms + TOKENS * token_ms}
    return best


def _answer(engine: EngineConfig, tokens: int) -> tuple[float, float]:
    """Load the model and let it answer once; return prompt and token in ms."""
    import numpy as np

    from s2a_bench.inference.llama_cpp import LlamaCppEngine
    from s2a_bench.types import Frame, Request

    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    frame = Frame(0, 0, 640, 480, "rgb8", pixels)
    model = LlamaCppEngine(engine.but(context=max(engine.context, 2048)))
    try:
        for _ in model.generate(Request("flash-attention", DEFAULT_PROMPT, (frame,), tokens)):
            pass
        facts = model.facts
        if not facts[PREDICTED_N]:
            raise EngineError("the model's answer is empty")
        return facts[PROMPT_MS], facts[PREDICTED_MS] / facts[PREDICTED_N]
    finally:
        model.close()


def main() -> int:
    """Measure what is asked for."""
    limit_threads()
    line = sys.stdin.readline()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints belongs in the log
    if not line:  # who started this process has gone
        return 0
    try:
        told: dict[str, Any] = {"address": "", "best": measured(EngineConfig(**json.loads(line)))}
    except S2AError as error:
        told = {"error": str(error), "kind": type(error).__name__}
    print(json.dumps(told), file=answers, flush=True)
    return 0


if __name__ == "__main__":
    with allowed():
        sys.exit(main())
