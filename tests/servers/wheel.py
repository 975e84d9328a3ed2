"""llama.cpp's own HTTP server, from the wheel `xllamacpp`: ``python -m tests.servers.wheel MODEL MMPROJ``.

It says its address on standard output and serves until standard input ends.
"""

from __future__ import annotations

import sys


def main(model: str, mmproj: str) -> None:
    from xllamacpp import CommonParams, Server  # type: ignore[import-not-found]

    wanted = CommonParams()
    wanted.model.path, wanted.mmproj.path = model, mmproj
    wanted.n_ctx, wanted.n_parallel = 4096, 1
    wanted.hostnames, wanted.port, wanted.endpoint_metrics = ["127.0.0.1"], 0, True
    server = Server(wanted)
    sys.stdout.write(f"{server.listening_address}\n")
    sys.stdout.flush()
    sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
