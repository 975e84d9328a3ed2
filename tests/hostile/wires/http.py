"""Hostile peers of our HTTP server and client."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Iterator, Sequence
from functools import cache

from s2a_bench.transport.http.native import PARAMETERS_HEADER, PATHS
from tests.hostile.suite import Attack, Case
from tests.hostile.tcp import CLIENTS as ANY_CLIENT
from tests.hostile.tcp import crowd, sends, sends_made, servers

CHAT = PATHS["as-deployed"]
MIB = 1 << 20
JSON = "Content-Type: application/json"


def head(*headers: str, path: str = CHAT, length: int | None = None) -> bytes:
    """Return the head of a request whose connection is closed after its answer."""
    lengths = [] if length is None else [f"Content-Length: {length}"]
    lines = [f"POST {path} HTTP/1.1", "Host: localhost", "Connection: close", *headers, *lengths]
    return "\r\n".join([*lines, "", ""]).encode()


def post(body: bytes, *headers: str, path: str = CHAT) -> bytes:
    """Return a whole request."""
    return head(*(headers or (JSON,)), path=path, length=len(body)) + body


def chat(prompt: str = '"go on"', fields: str = "", path: str = CHAT) -> bytes:
    """Return a request whose prompt and further fields are JSON text."""
    return post(
        f'{{"messages": [{{"role": "user", "content": {prompt}}}]{fields and ", " + fields}}}'.encode(), path=path
    )


def binary(body: bytes, fields: str = "{}", kind: str = "image/png") -> bytes:
    """Return a request of the variant whose body is the picture."""
    return post(body, f"Content-Type: {kind}", f"{PARAMETERS_HEADER}: {fields}", path=PATHS["binary"])


@cache
def png_of_zeros(width: int, height: int) -> bytes:
    """Return a PNG of one bit a pixel, made without its pixels: 30000x30000 are 110 kB, and 2.7 GB once decoded."""
    pack = zlib.compressobj(9)
    rows = b"".join(pack.compress(bytes(1 + (width + 7) // 8)) for _ in range(height)) + pack.flush()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    ihdr = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", ihdr) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def bomb() -> bytes:
    """Return a small picture of 900 million pixels."""
    return png_of_zeros(30_000, 30_000)


def bomb_uri(path: str) -> Sequence[bytes]:
    """Return a request with the bomb in a data URI."""
    uri = "data:image/png;base64," + base64.b64encode(bomb()).decode()
    return [chat(json.dumps([{"type": "image_url", "image_url": {"url": uri}}]), path=path)]


def parentheses(number: int) -> str:
    """Return a grammar as deep as that."""
    return json.dumps("root ::= " + "(" * number + '"a"' + ")" * number)


REFUSED = "^HTTP/1.1 400 .*"
GOES_ON = '"stream": true, "max_tokens": 5000'
CHUNKS = "Transfer-Encoding: chunked"


def _clients(path: str) -> Iterator[Case[Attack]]:
    """Yield what both of our servers outlive, at a path that takes JSON."""
    yield Case("half the headers, then gone", sends(head(path=path)[:40], then="goes"))
    yield Case("half the body, then gone", sends(head(JSON, path=path, length=1000) + b"{", then="goes"))
    yield Case(
        "body a byte at a time", sends(head(JSON, path=path, length=1000), *[b" "] * 20, every_s=0.1, then="goes")
    )
    yield Case("1 GiB announced", sends(head(JSON, path=path, length=1 << 30), bytes(MIB)), "^HTTP/1.1 413 ")
    yield Case("64 MiB of spaces", sends_made(lambda: [post(b" " * 64 * MIB, path=path)]), REFUSED)
    lines = [b"x-%d: %s\r\n" % (n, b"a" * 100) for n in range(10_000)]
    yield Case("1 MiB of headers", sends(head(path=path)[:-2], *lines))
    both = head("Content-Length: 3", CHUNKS, path=path)
    yield Case("length and chunks", sends(both + b"0\r\n\r\nGET / HTTP/1.1\r\n\r\n"))
    many = chat(path=path).replace(b"Connection: close\r\n", b"") * 200
    yield Case("200 requests in one piece", sends(many, chat(path=path)))
    yield Case("deep JSON", sends(post(b"[" * MIB, path=path)), REFUSED)
    yield Case("picture of 900 million pixels", sends_made(lambda: bomb_uri(path)), REFUSED + "IMAGE_PIXELS")
    yield Case("bad grammar", sends(chat(fields=f'"grammar": {parentheses(20_000)}', path=path)))
    goes_on = chat(fields=GOES_ON, path=path)
    yield Case("gone in the middle of an answer", sends(goes_on, then="goes"))
    yield Case("100 clients that go", crowd(100, sends(goes_on, then="goes")))
    yield Case("a page in a browser", sends(head("Origin: http://localhost", path=path, length=0)), "^HTTP/1.1 403 ")
    stranger = head(path=path, length=0).replace(b"localhost", b"example.com")
    yield Case("a name that means us", sends(stranger), "^HTTP/1.1 403 ")


FAST_CHAT = PATHS["best-effort"]
CLIENTS: tuple[Case[Attack], ...] = (
    *ANY_CLIENT,
    *_clients(CHAT),
    Case("1 GiB unsaid", sends(head(JSON, CHUNKS), *[b"100000\r\n" + bytes(MIB) + b"\r\n"] * 1024)),
    Case("chunk of 2^64 bytes", sends(head(JSON, CHUNKS) + b"FFFFFFFFFFFFFFFF\r\nzz\r\n")),
)
FAST: tuple[Case[Attack], ...] = (
    *ANY_CLIENT,
    *_clients(FAST_CHAT),
    Case("64 MiB of zeros as pixels", sends_made(lambda: [binary(bytes(64 * MIB))]), REFUSED),
    Case("deep parameters", sends(binary(b"", "[" * 50_000)), REFUSED),
    Case(
        "picture of 900 million pixels as the body",
        sends_made(lambda: [binary(bomb())]),
        REFUSED + "IMAGE_PIXELS",
    ),
)


CONTROL = "\x1b[2J\r\nOK: all is well\x07\x00"

SERVERS = servers("http://")
"""The client also meets those of `tests/servers/hostile.py`, in `test_client`."""
