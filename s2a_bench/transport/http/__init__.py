"""HTTP: our server in three variants of OpenAI's dialect, and a client that speaks to other servers too."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

from pydantic import create_model

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import HEADERS_OFF_MS, PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.options import need_program
from s2a_bench.transport import ACTIONS, TOKENS, Capabilities, Choice, Handler, Program, Server, Urls, Wiring
from s2a_bench.transport.defaults import BESIDE
from s2a_bench.transport.http.dialects import DIALECTS, open_dialect
from s2a_bench.transport.http.options import WHEEL, HttpOptions
from s2a_bench.transport.listening import ListeningTransport, read_key

VARIANTS = ("as-deployed", "best-effort", "binary", "llama-server")
BINARY, LLAMA_SERVER = VARIANTS[2:]
FAST = VARIANTS[1:3]
PACKAGES = "fastapi", "h11", "httptools", "httpx", "orjson", "pybase64", "starlette", "uvicorn", "uvloop"

HEADERS_MS = Fact("headers_ms", "ms", "last byte packed to the headers of a black box's answer")
THINKING_PIECES = Fact("thinking_pieces", "", "messages of the answer that were thinking")
THINKING_MS = Fact("thinking_ms", "ms", "first thinking to the first token")


def installed_llama_server() -> Path | None:
    """Find llama.cpp's server: on PATH, else in the wheel, which needs the extra for models; None without either."""
    if program := shutil.which("llama-server"):
        return Path(program)
    return WHEEL if extras.installed(str(WHEEL)) and extras.installed("gguf") else None


class Http(ListeningTransport[HttpOptions]):
    name = "http"
    variants = VARIANTS
    payloads = ("jpeg", "jpeg-preencoded", "png", "raw")
    answer_kinds = (TOKENS, ACTIONS)
    accepts_state = True
    stages = {
        "base64_encode": "encode",
        "json_pack": "pack",
        "ingest": "ingest",  # last byte packed -> slot started, where the server is a llama-server
        "json_parse": "parse",
        "base64_decode": "decode",
    }
    facts = (PAYLOAD_BYTES, RECONNECTS, HEADERS_MS, HEADERS_OFF_MS, THINKING_PIECES, THINKING_MS)
    order = 10
    style = {
        "as-deployed": ("#D55E00", "-"),
        "best-effort": ("#E69F00", "--"),
        "binary": ("#CC79A7", "-."),
        "llama-server": ("#8C510A", ":"),
    }
    compared_with = BESIDE
    client_class = "s2a_bench.transport.http.client:HttpClient"
    reader = "s2a_bench.transport.http.tap:HttpReader"
    urls = Urls(
        HttpOptions.SCHEMES,
        examine="s2a_bench.transport.http.detect:examine",
        cache_hits="s2a_bench.transport.http.detect:cache_hits",
    )

    @cached_property
    def options(self) -> type[HttpOptions]:  # type: ignore[override] # dialects, which import this package, have a part
        """Return its options, with those that dialects declare."""
        declared: Any = dict.fromkeys(each.options for _, each in DIALECTS.loaded() if each.options)
        return create_model("HttpOptions", __base__=(HttpOptions, *declared))

    @cached_property
    def packages(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(sorted({*PACKAGES, *(name for _, each in DIALECTS.loaded() for name in each.packages)}))

    def server(self, wiring: Wiring[HttpOptions], handler: Handler) -> Server:
        kind = "fast:FastServer" if wiring.variant in FAST else "server:HttpServer"
        return cast("Server", resolve_name(f"s2a_bench.transport.http.{kind}")(wiring, handler))

    def measured(self, choice: Choice[HttpOptions]) -> Sequence[str]:
        """Return the variants that the server speaks; llama.cpp's server too if it is installed and comparable."""
        options = choice.options
        if options.url:
            return VARIANTS[:2]
        comparable = choice.engine == "llama" and options.payload in {"", "jpeg"} and installed_llama_server()
        return VARIANTS if options.llama_server or comparable else VARIANTS[:3]

    def capabilities(self, choice: Choice[HttpOptions]) -> Capabilities[HttpOptions]:
        """Return the capabilities of our server, or of a black box's dialect.

        The options name llama.cpp's server only in its variant: the one on PATH, else the wheel's.
        """
        options, jpeg = choice.options, self.payloads[:2]
        if choice.variant == LLAMA_SERVER:
            options = options.but(llama_server=options.llama_server or installed_llama_server(), port=0)
        elif options.llama_server:
            options = options.but(llama_server=None)
        can = replace(super().capabilities(choice), options=options, server="fast" if choice.variant in FAST else "")
        if not options.external:
            return replace(can, payloads=jpeg) if choice.variant == LLAMA_SERVER else can
        from s2a_bench.transport.http.detect import OWNERS

        possible = (options.spoken,) if options.spoken else ("openai", *OWNERS.values())
        dialects = [open_dialect(name, options) for name in possible]
        return replace(
            can,
            payloads=jpeg if choice.variant == LLAMA_SERVER else dialects[0].payloads,
            answer_kinds=dialects[0].answer_kinds,
            accepts_state=dialects[0].accepts_state,
            takes_task=dialects[0].takes_task,
            facts=(*self.facts, *(fact for dialect in dialects for fact in dialect.facts)),
        )

    def require(self, choice: Choice[HttpOptions]) -> None:
        variant, options = choice.variant, choice.options
        if options.dialect:
            open_dialect(options.dialect, options).check(choice.cameras, choice.state)
        if options.url and variant in {BINARY, LLAMA_SERVER}:
            raise UsageError(f"`transport` {self.name}/{variant} needs our own server; leave it out with `url`")
        if variant == LLAMA_SERVER:
            if options.llama_server is None:
                raise UsageError(
                    f"`transport` http/{LLAMA_SERVER}: there is none on PATH; name one with `llama_server`, or take "
                    f"the wheel: {extras.how_to_install(LLAMA_SERVER)}"
                )
            if options.llama_server != WHEEL:
                need_program("llama_server", options.llama_server)
            if choice.engine != "llama":
                raise UsageError(f"`llama_server` runs a model; leave out `engine` {choice.engine}")
        read_key(options.api_key_env)

    def program(self, options: HttpOptions) -> Program | None:
        if options.llama_server is None:
            return None
        kind = "llama-server-wheel" if options.llama_server == WHEEL else LLAMA_SERVER
        return Program(kind, options.llama_server, options.port)

    def ready(self, wiring: Wiring[HttpOptions]) -> str:
        from s2a_bench.transport.http.native import PATHS

        callers = wiring.options.callers("have the key in {}, /health for all")
        return f"serving at {wiring.address}{PATHS[wiring.variant]}{callers}"


HTTP = Http()
