"""llama.cpp's own HTTP server from the wheel xllamacpp: ``python -m s2a_bench.harness.llama_wheel``.

It reads one JSON line from standard input (`server_settings`), answers with ``{"address": ..., "version": ...}`` or
``{"error": ...}`` on one line, and serves until standard input ends.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import chat_template


def server_settings(engine: EngineConfig, port: int, *, ignore_end: bool) -> dict[str, Any]:
    """Return settings under which the server computes as the llama engine does, like `llama_flags` of a program."""
    return {
        "model": str(engine.model),
        "mmproj": str(engine.mmproj or ""),
        "chat_template": chat_template(engine),
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
    line = sys.stdin.readline()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what llama.cpp prints belongs in the log
    if not line:  # the parent process has ended
        return 0
    llama = extras.require("xllamacpp", "llama-server")
    settings = json.loads(line)
    params = llama.CommonParams()
    params.model.path, params.mmproj.path = settings["model"], settings["mmproj"]
    if settings["chat_template"]:
        params.chat_template, params.use_jinja = settings["chat_template"], True
    # one slot, as slots divide the context among them; fitting would change these settings to the free memory
    params.n_ctx, params.n_parallel, params.fit_params = settings["context"], 1, False
    params.n_batch = params.n_ubatch = settings["batch"]
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = settings["threads"]
    params.n_gpu_layers, params.mmproj_use_gpu = settings["gpu_layers"], settings["gpu_layers"] != 0
    params.cache_type_k = params.cache_type_v = getattr(llama.ggml_type, f"GGML_TYPE_{settings['kv_type'].upper()}")
    flash = {"auto": "AUTO", "on": "ENABLED", "off": "DISABLED"}[settings["flash_attention"]]
    params.flash_attn_type = getattr(llama.llama_flash_attn_type, f"LLAMA_FLASH_ATTN_TYPE_{flash}")
    params.sampling.ignore_eos = settings["ignore_end"]
    params.hostnames, params.port, params.endpoint_metrics = ["127.0.0.1"], settings["port"], True
    try:
        if settings["gpu_layers"] and all("CPU" in device["type"].name for device in llama.get_device_info()):
            raise UsageError("`gpu_layers`: xllamacpp is built for the CPU alone; name another `llama_server`")
        server = llama.Server(params)
    except Exception as error:  # noqa: BLE001 - the parent process reports whatever llama.cpp raises
        kind, where = ("UsageError", "") if isinstance(error, UsageError) else ("EngineError", "llama-server: ")
        print(json.dumps({"error": f"{where}{error}", "kind": kind}), file=answers, flush=True)
        return 1
    version = f"xllamacpp {llama.__version__}"
    print(json.dumps({"address": server.listening_address, "version": version}), file=answers, flush=True)
    sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
