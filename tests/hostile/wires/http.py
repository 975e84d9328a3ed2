"""Hostile peers of our HTTP servers and client."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from functools import cache

from s2a_bench.transport.http.native import PARAMETERS_HEADER, PATHS
from tests.hostile.peers import CLOSED, FORGED, MIB, NOISE, Case, Server, answers, crowd, sends
from tests.servers.sockets import head as response

JSON = "Content-Type: application/json"
CHUNKS = "Transfer-Encoding: chunked"
REFUSED = "^HTTP/1.1 4"
BUSY_OR_ANSWERED = f"^HTTP/1.1 (200|503) |^{CLOSED}"


def head(*headers: str, path: str, length: int | None = None) -> bytes:
    """Return the head of a request whose connection is closed after its answer."""
    lengths = [] if length is None else [f"Content-Length: {length}"]
    lines = [f"POST {path} HTTP/1.1", "Host: localhost", "Connection: close", *headers, *lengths]
    return "\r\n".join([*lines, "", ""]).encode()


def post(body: bytes, path: str, *headers: str) -> bytes:
    return head(*(headers or (JSON,)), path=path, length=len(body)) + body


def chat(path: str, prompt: str = '"go on"', fields: str = '"max_tokens": 3') -> bytes:
    """Return a request whose prompt and further fields are JSON text."""
    return post(f'{{"messages": [{{"role": "user", "content": {prompt}}}], {fields}}}'.encode(), path)


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


def picture(path: str, data: bytes) -> bytes:
    uri = "data:image/png;base64," + base64.b64encode(data).decode()
    return chat(path, json.dumps([{"type": "image_url", "image_url": {"url": uri}}]))


def clients(variant: str) -> tuple[Case, ...]:
    path = PATHS[variant]
    goes_on = chat(path, fields='"stream": true, "max_tokens": 5000')
    kept = chat(path).replace(b"Connection: close\r\n", b"")
    both = head("Content-Length: 3", CHUNKS, path=path) + b"0\r\n\r\nGET / HTTP/1.1\r\n\r\n"
    return (
        Case("noise", sends(NOISE, b"\r\n\r\n"), f"{REFUSED}|^{CLOSED}"),
        Case("half a head", sends(head(path=path)[:40], then="leaves")),
        Case("half a body", sends(head(JSON, path=path, length=1000) + b"{", then="resets")),
        Case("a length and chunks", sends(both)),
        Case("200 requests in one piece", sends(kept * 200, chat(path)), CLOSED),
        Case("no JSON", sends(post(b'{"messages": "\xff', path)), REFUSED),
        Case("deep JSON", sends(post(b"[" * MIB, path)), REFUSED),
        Case("half a surrogate pair", sends(chat(path, '"\\ud800"')), REFUSED),
        Case("a number that is none", sends(chat(path, fields='"max_tokens": 1e99')), REFUSED),
        Case("no picture", sends(picture(path, b"GIF89a" + bytes(100))), REFUSED),
        Case("gone in the middle of an answer", sends(goes_on, then="leaves")),
        Case("100 that come and go", crowd(100, sends(goes_on, then="resets"))),
    )


def large(variant: str) -> tuple[Case, ...]:
    path = PATHS[variant]
    lines = [b"x-%d: %s\r\n" % (n, b"a" * 100) for n in range(10_000)]
    unsaid = [head(JSON, CHUNKS, path=path), *[b"100000\r\n" + bytes(MIB) + b"\r\n"] * 1024]
    return (
        Case("1 GiB announced", sends(head(JSON, path=path, length=1 << 30), bytes(MIB)), REFUSED),
        Case("1 GiB in chunks", sends(*unsaid), f"{REFUSED}|^{CLOSED}"),
        Case("60 MiB of spaces", sends(lambda: post(b" " * 60 * MIB, path)), REFUSED),
        Case("1 MiB of headers", sends(head(path=path)[:-2], *lines), f"{REFUSED}|^{CLOSED}"),
        Case("a picture of 900 million pixels", sends(lambda: picture(path, bomb())), REFUSED),
        Case("300 connections at once", crowd(300, sends(chat(path))), BUSY_OR_ANSWERED),
    )


def binary(body: bytes, fields: str = "{}") -> bytes:
    """Return a request of the variant whose body is the picture."""
    return post(body, PATHS["binary"], "Content-Type: image/png", f"{PARAMETERS_HEADER}: {fields}")


CLIENTS = clients("as-deployed")
LARGE = large("as-deployed")
FAST = (*clients("best-effort"), Case("deep parameters", sends(binary(b"", "[" * 50_000)), REFUSED))
FAST_LARGE = (
    *large("best-effort"),
    Case("60 MiB of zeros as a picture", sends(lambda: binary(bytes(60 * MIB))), REFUSED),
    Case("900 million pixels as the body", sends(lambda: binary(bomb())), REFUSED),
)


def delta(**fields: object) -> bytes:
    """Return one chunk of a chat completion."""
    choice = {"index": 0, "delta": fields, "finish_reason": None}
    return b"data: " + json.dumps({"choices": [choice]}).encode() + b"\n\n"


def compressed() -> bytes:
    """Return 64 MiB in 64 kB."""
    return zlib.compress(bytes(64 * MIB), 9, wbits=31)


UNENDED = response().removesuffix(b"\r\n")
BYTES = r"sent more than \d+ bytes for 8 tokens"
LATE = r"did not end its answer within 1 s; see `deadline` and `max_tokens`"
MANY = 1 << 12
"""Messages sent at once: a test's server is slower than its client otherwise."""
SERVERS = (
    Server("silence", answers(), timeout_s=0.5),
    Server("gone at once", answers(leaves=True)),
    Server("noise", answers(NOISE)),
    Server("endless zeros", answers(again=bytes(1 << 16))),
    Server("endless headers", answers(UNENDED, again=b"X-More: x\r\n" * MANY), "broke the connection"),
    Server("endless tokens", answers(response(), again=delta(content="go ") * MANY), BYTES),
    Server("tokens, slowly", answers(response(), again=delta(content="go "), every_s=0.05), LATE, deadline_s=1.0),
    Server("endless thoughts", answers(response(), again=delta(reasoning_content="hmm ") * MANY), BYTES),
    Server("endless comments", answers(response(), again=b": ping\n\n" * MANY), BYTES),
    Server("an endless line", answers(response(), b"data: ", again=b"x" * MANY), BYTES),
    Server("an endless event", answers(response(), again=b"data: x\n" * MANY), BYTES),
    Server("endless bare JSON", answers(response(), again=b"[\n" * MANY), BYTES),
    Server("an endless refusal", answers(response("400 No", "text/plain"), again=b"no " * MANY), "answered 400: no no"),
    Server(
        "a refusal, slowly",
        answers(response("400 No", "text/plain"), again=b"no ", every_s=0.05),
        "answered 400: no no",
        deadline_s=1.0,
    ),
    Server("a page", answers(response(kind="text/html"), b"<p>", leaves=True), "as text/html where"),
    Server("a forged line", answers(response("400 No", "text/plain"), FORGED.encode(), leaves=True), "all is well"),
    Server(
        "a compressed answer",
        answers(response("200 OK", "text/event-stream", "Content-Encoding: gzip"), lambda *_: compressed()),
        r"compressed its answer \(gzip\)",
    ),
)
