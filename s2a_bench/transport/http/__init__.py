"""HTTP: our own server in three variants of OpenAI's dialect, and a client that speaks to other servers too."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from s2a_bench.errors import UsageError
from s2a_bench.facts import HEADERS_OFF_MS, PAYLOAD_BYTES, Fact
from s2a_bench.transport import Client, Handler, Program, Server, Transport, Wiring
from s2a_bench.transport.http.options import HttpOptions

VARIANTS = ("as-deployed", "best-effort", "binary")
BINARY = VARIANTS[2]

RECONNECTS = Fact("reconnects", "", "1 where the server had closed the kept connection")
HEADERS_MS = Fact("headers_ms", "ms", "last byte packed to the headers of a black box's answer")
THINKING_PIECES = Fact("thinking_pieces", "", "messages of the answer that were thinking")
THINKING_MS = Fact("thinking_ms", "ms", "first thinking to the first token")


class Http(Transport[HttpOptions]):
    """Base64 and JSON as usually deployed, at their best, and the binary control."""

    name = "http"
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
    looks = {"as-deployed": ("#D55E00", "-"), "best-effort": ("#E69F00", "--"), "binary": ("#CC79A7", "-.")}
    compared_with = ("ros", "loopback")
    packages = (
        *("fastapi", "httptools", "httpx", "json-numpy", "orjson", "pybase64", "starlette", "uvicorn", "uvloop"),
    )
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

    def measured(self, options: HttpOptions, chosen: Sequence[str]) -> Sequence[str]:
        """Return all that the server speaks."""
        return chosen or [name for name in VARIANTS if name != BINARY or not self.foreign_by(options)]

    def travels(self, variant: str, options: HttpOptions) -> tuple[str, ...]:  # noqa: ARG002 - the same for all
        """Return what our server takes, or what the dialect of a black box has words for."""
        if not self.foreign_by(options):
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

        if (field := self.foreign_by(options)) and variant == BINARY:
            raise UsageError(f"`http`: binary needs our own server; leave it out with `{field}`")
        if options.llama_server and engine != "llama":
            raise UsageError(f"`llama_server` runs a model; leave out `engine` {engine}")
        read_key(options.api_key_env)

    def foreign(self, options: HttpOptions) -> str:
        """Return the URL that a user gave."""
        return options.url

    def cache_hits(self, wiring: Wiring[HttpOptions]) -> Mapping[str, float]:
        """Return the counters of cache hits that a black box tells by its metrics."""
        from s2a_bench.transport.credentials import read_key
        from s2a_bench.transport.http.detect import cache_hits

        return cache_hits(wiring.address, read_key(wiring.options.api_key_env)) if wiring.black_box else {}

    def program(self, options: HttpOptions) -> Program | None:
        """Return llama.cpp's server where its program is named."""
        return Program("llama-server", options.llama_server, options.port) if options.llama_server else None

    def bind(self, options: HttpOptions, taken: Sequence[str]) -> str:
        """Return ``host:port``, with any free port where another server of ours has this one."""
        wanted = f"{options.host}:{options.port}"
        return f"{options.host}:0" if wanted in taken else wanted

    def ready(self, wiring: Wiring[HttpOptions], address: str) -> str:
        """Return where chats are completed, and for whom."""
        key, everybody = wiring.options.api_key_env, wiring.options.no_auth
        whom = f" for who has the key in ${key}, /health for all" if key else " for all who reach it" * everybody
        return f"serving at {address}/v1/chat/completions{whom}"


HTTP = Http()
