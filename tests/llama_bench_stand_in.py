"""A stand-in of llama.cpp's llama-bench: a program that answers like ``llama-bench -o json`` (0c1e570): no model.

Run as a script it takes llama-bench's long flags, refuses unknown ones as llama-bench does, and "decodes" at
``S2A_STAND_IN_RATE`` tokens a second; ``S2A_STAND_IN_FAULT`` is one of crash, illegal (it dies by an
illegal instruction), garbage, empty, old (it reads ``--flash-attn`` as 0 or 1, as all did before 2026).
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

FLAGS = {
    "--model": str,
    "--output": str,
    "--repetitions": int,
    "--n-prompt": int,
    "--n-gen": int,
    "--n-depth": int,
    "--threads": int,
    "--n-gpu-layers": int,
    "--batch-size": int,
    "--ubatch-size": int,
    "--cache-type-k": str,
    "--cache-type-v": str,
    "--flash-attn": str,
}


def install(folder: Path) -> Path:
    """Write the stand-in as an executable file and return its path."""
    program = folder / "llama-bench"
    program.write_text(f"#!{sys.executable}\n" + Path(__file__).read_text())
    program.chmod(0o755)
    return program


def main() -> int:
    """Answer one call."""
    given: dict[str, str | int] = {}
    words = sys.argv[1:]
    while words:
        flag = words.pop(0)
        if flag not in FLAGS or not words:
            sys.stderr.write(f"error: invalid parameter for argument: {flag}\n")
            return 1
        given[flag] = FLAGS[flag](words.pop(0))
    fault = os.environ.get("S2A_STAND_IN_FAULT", "")
    if fault == "crash":
        sys.stderr.write("ggml: loading\nmain: error: failed to load model 'x.gguf'\n")
        return 1
    if fault == "illegal":
        os.kill(os.getpid(), signal.SIGILL)
    if fault == "garbage":
        sys.stdout.write("| model | size |\n")
        return 0
    rate = float(os.environ.get("S2A_STAND_IN_RATE", "1000"))
    n_gen = int(given["--n-gen"])
    took_ns = round(n_gen / rate * 1e9)
    test = {
        "build_commit": "0c1e570",
        "build_number": 1,
        "cpu_info": "AMD EPYC",
        "backends": "CPU",
        "model_filename": given["--model"],
        "model_type": "qwen2 ?B F16",
        "n_batch": given["--batch-size"],
        "n_ubatch": given["--ubatch-size"],
        "n_threads": given["--threads"],
        "type_k": given["--cache-type-k"],
        "type_v": given["--cache-type-v"],
        "n_gpu_layers": given["--n-gpu-layers"],
        "flash_attn": False if fault == "old" else {"auto": -1, "off": 0, "on": 1}[str(given["--flash-attn"])],
        "n_prompt": given["--n-prompt"],
        "n_gen": n_gen,
        "n_depth": given.get("--n-depth", 0),
        "avg_ns": took_ns,
        "stddev_ns": 0,
        "avg_ts": rate,
        "stddev_ts": 0.0,
        "samples_ns": [took_ns] * int(given["--repetitions"]),
        "samples_ts": [rate] * int(given["--repetitions"]),
    }
    sys.stdout.write(json.dumps([] if fault == "empty" else [test], indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
