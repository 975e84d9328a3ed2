"""HTTP: our own server in three variants of OpenAI's dialect, and a client that speaks to other servers too."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import HEADERS_OFF_MS, PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.transport import Client, Handler, Program, Server, Wiring
from s2a_bench.transport.http.options import HttpOptions
from s2a_bench.transport.listening import Listening

VARIANTS = ("as-deployed", "best-effort", "binary", "llama-server")
BINARY, LLAMA_SERVER = VARIANTS[2:]
WHEEL = Path("xllamacpp")
"""Stands for llama.cpp's server out of the wheel of that name."""

HEADERS_MS = Fact("headers_ms", "ms", "last byte packed to the headers of a black box's answer")
THINKING_PIECES = Fact("thinking_pieces", "", "messages of the answer that were thinking")
THINKING_MS = Fact("thinking_ms", "ms", "first thinking to the first token")


def found_llama_server() -> Path | None:
    """Find llama.cpp's own server: on PATH, else in the wheel, which reads models of the extra; None without either."""
    if found := shutil.which("llama-server"):
        return Path(found)
    return WHEEL if extras.installed(str(WHEEL)) and extras.installed("gguf") else None


class Http(Listening[HttpOptions]):
    """Base64 and JSON as usually deployed, at their best, the binary control, and llama.cpp's own server."""

    name = "http"
    for_policies = True
    options = HttpOptions
    variants = VARIANTS
    payloads = ("jpeg", "jpeg-preencoded", "png", "raw")
    stages = {
        "base64_encode": "encode",
        "json_pack": "pack",
        "ingest": "ingest",  # last byte packed -> slot started, where the server is a llama-server
        "json_parse": "parse",
        "base64_decode": "decode",
    }
    tells = (PAYLOAD_BYTES, RECONNECTS, HEADERS_MS, HEADERS_OFF_MS, THINKING_PIECES, THINKING_MS)
    order = 10
    looks = {
        "as-deployed": ("#D55E00", "-"),
        "best-effort": ("#E69F00", "--"),
        "binary": ("#CC79A7", "-."),
        "llama-server": ("#8C510A", ":"),
    }
    compared_with = ("ros", "loopback")
    packages = (
        *("fastapi", "httptools", "httpx", "json-numpy", "orjson", "pybase64", "starlette", "uvicorn", "uvloop"),
    )
    schemes = HttpOptions.SCHEMES
    examines = "s2a_bench.transport.http.dangers:examine"
    elsewhere = ("url", "llama_server")
    serving = {"port": 8080}

    def client(self, wiring: Wiring[HttpOptions], alive: Callable[[], bool]) -> Client:
        """Prepare to ask the server at ``wiring.address``, a base URL."""
        from s2a_bench.transport.http.client import HttpClient

        return HttpClient(wiring, alive)

    def server(self, wiring: Wiring[HttpOptions], handler: Handler) -> Server:
        """Bind ``host:port``; raises PortInUse."""
        from s2a_bench.transport.http.server import HttpServer

        return HttpServer(wiring, handler)

    def measured(self, options: HttpOptions, chosen: Sequence[str], engine: str) -> Sequence[str]:
        """Return all that the server speaks; llama.cpp's own too where it is there and has the same to do."""
        if chosen:
            return chosen
        if options.url:
            return VARIANTS[:2]
        wanted = engine == "llama" and options.payload in {"", "jpeg"} and found_llama_server()
        return VARIANTS if options.llama_server or wanted else VARIANTS[:3]

    def of_variant(self, variant: str, options: HttpOptions) -> HttpOptions:
        """Return options that name llama.cpp's server for its own variant alone: the one on PATH, else the wheel's."""
        if variant != LLAMA_SERVER:
            return options.but(llama_server=None) if options.llama_server else options
        return options.but(llama_server=options.llama_server or found_llama_server(), port=0)

    def travels(self, variant: str, options: HttpOptions) -> tuple[str, ...]:
        """Return what our server takes, or what the dialect of a black box has words for."""
        if variant == LLAMA_SERVER:
            return ("jpeg",)
        if not options.url:
            return self.payloads
        from s2a_bench.transport.http.dialects import open_dialect

        return open_dialect(options.spoken or "openai").payloads

    def told(self, options: HttpOptions) -> Sequence[Fact]:
        """Return what the client tells, and what the dialect of a black box has words for."""
        if not self.foreign_by(options):
            return self.tells
        from s2a_bench.transport.http.detect import OWNERS
        from s2a_bench.transport.http.dialects import open_dialect

        spoken = (options.spoken,) if options.spoken else ("openai", *OWNERS.values())  # what it may turn out to be
        return (*self.tells, *(fact for name in spoken for fact in open_dialect(name).tells))

    def check(self, variant: str, options: HttpOptions, *, mode: str, engine: str) -> None:  # noqa: ARG002
        """Refuse what only our own server knows, a key that is not there, and a model's server without a model."""
        from s2a_bench.transport.credentials import read_key

        if options.url and variant in {BINARY, LLAMA_SERVER}:
            raise UsageError(f"`http`: {variant} needs our own server; leave it out with `url`")
        if variant == LLAMA_SERVER:
            if options.llama_server is None:
                raise UsageError(
                    f"`transport` http/{LLAMA_SERVER}: there is none on PATH; name one with `llama_server`, or take "
                    "the wheel: pip install 's2a-bench[llama-server]'"
                )
            if engine != "llama":
                raise UsageError(f"`llama_server` runs a model; leave out `engine` {engine}")
        read_key(options.api_key_env)

    def cache_hits(self, wiring: Wiring[HttpOptions]) -> Mapping[str, float]:
        """Return the counters of cache hits that a black box tells by its metrics."""
        from s2a_bench.transport.credentials import read_key
        from s2a_bench.transport.http.detect import cache_hits

        return cache_hits(wiring.address, read_key(wiring.options.api_key_env)) if wiring.black_box else {}

    def program(self, options: HttpOptions) -> Program | None:
        """Return llama.cpp's server where its program is named."""
        if options.llama_server is None:
            return None
        kind = "llama-server-wheel" if options.llama_server == WHEEL else "llama-server"
        return Program(kind, options.llama_server, options.port)

    def ready(self, wiring: Wiring[HttpOptions], address: str) -> str:
        """Return where chats are completed, and for whom."""
        key, everybody = wiring.options.api_key_env, wiring.options.no_auth
        whom = f" for who has the key in ${key}, /health for all" if key else " for all who reach it" * everybody
        return f"serving at {address}/v1/chat/completions{whom}"


HTTP = Http()
