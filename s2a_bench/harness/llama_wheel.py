"""llama.cpp's own HTTP server out of the wheel xllamacpp: ``python -m s2a_bench.harness.llama_wheel``.

It reads one JSON line from standard input, `told`, answers with one, ``{"address": ..., "version": ...}`` or
``{"error": ...}``, and serves until standard input ends.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig


def told(engine: EngineConfig, port: int, *, ignore_end: bool) -> dict[str, Any]:
    """Return what makes the server compute as our own engine does, as `llama_flags` says it to a program."""
    return {
        "model": str(engine.model),
        "mmproj": str(engine.mmproj),
        "threads": engine.threads or len(os.sched_getaffinity(0)),
        "gpu_layers": engine.gpu_layers,
        "context": engine.context,
        "batch": min(engine.batch, engine.context),
        "kv_type": engine.kv_type,
        "flash_attention": engine.flash_attention,
        "port": port,
        "ignore_end": ignore_end,
    }


def main() -> int:
    """Serve as told."""
    line = sys.stdin.readline()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what llama.cpp prints belongs in the log
    if not line:  # who started this process has gone
        return 0
    llama = extras.require("xllamacpp", "llama-server")
    asked = json.loads(line)
    wanted = llama.CommonParams()
    wanted.model.path, wanted.mmproj.path = asked["model"], asked["mmproj"]
    wanted.n_ctx, wanted.n_parallel, wanted.fit_params = asked["context"], 1, False
    wanted.n_batch = wanted.n_ubatch = asked["batch"]
    wanted.cpuparams.n_threads = wanted.cpuparams_batch.n_threads = asked["threads"]
    wanted.n_gpu_layers, wanted.mmproj_use_gpu = asked["gpu_layers"], asked["gpu_layers"] != 0
    wanted.cache_type_k = wanted.cache_type_v = getattr(llama.ggml_type, f"GGML_TYPE_{asked['kv_type'].upper()}")
    flash = {"auto": "AUTO", "on": "ENABLED", "off": "DISABLED"}[asked["flash_attention"]]
    wanted.flash_attn_type = getattr(llama.llama_flash_attn_type, f"LLAMA_FLASH_ATTN_TYPE_{flash}")
    wanted.sampling.ignore_eos = asked["ignore_end"]
    wanted.hostnames, wanted.port, wanted.endpoint_metrics = ["127.0.0.1"], asked["port"], True
    try:
        if asked["gpu_layers"] and not any("CPU" not in device["type"].name for device in llama.get_device_info()):
            raise UsageError("`gpu_layers`: xllamacpp is built for the CPU alone; name another `llama_server`")
        server = llama.Server(wanted)
    except Exception as error:  # noqa: BLE001 - whatever llama.cpp says, who started it must hear of it
        kind, where = ("UsageError", "") if isinstance(error, UsageError) else ("EngineError", "llama-server: ")
        print(json.dumps({"error": f"{where}{error}", "kind": kind}), file=answers, flush=True)
        return 1
    version = f"xllamacpp {llama.__version__}"
    print(json.dumps({"address": server.listening_address, "version": version}), file=answers, flush=True)
    sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
