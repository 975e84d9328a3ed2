"""The servers of the shoot-out, each in its usual form."""

from __future__ import annotations

import asyncio
import http.server
import socket
from collections.abc import Callable
from threading import Thread
from typing import Any, Final

import cv2
import numpy as np

from benchmarks.http_shootout import REPLY, STREAM

HEAD: Final = b"HTTP/1.1 200 OK\r\ncontent-type: text/event-stream\r\ncontent-length: %d\r\n\r\n" % len(REPLY)


def _use(body: Any) -> None:
    """Do what a server does with the pixels."""
    pixels = np.frombuffer(body, np.uint8)
    cv2.cvtColor(pixels.reshape(-1, 1, 3), cv2.COLOR_BGR2RGB)


async def _asgi(scope: Any, receive: Any, send: Any) -> None:
    """Answer without a framework."""
    if scope["type"] != "http":
        return
    pieces = []
    while True:
        event = await receive()
        pieces.append(event.get("body", b""))
        if not event.get("more_body"):
            break
    _use(pieces[0] if len(pieces) == 1 else b"".join(pieces))
    headers = [(b"content-type", STREAM.encode()), (b"content-length", b"%d" % len(REPLY))]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": REPLY})


def _wsgi(environ: dict[str, Any], start_response: Any) -> list[bytes]:
    """Answer as a WSGI application."""
    _use(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
    start_response("200 OK", [("content-type", STREAM), ("content-length", str(len(REPLY)))])
    return [REPLY]


def _on_fastapi(listener: socket.socket) -> None:
    from fastapi import FastAPI, Request
    from fastapi.concurrency import run_in_threadpool
    from fastapi.responses import Response

    app = FastAPI()

    async def answer(request: Request) -> Response:
        await run_in_threadpool(_use, await request.body())
        return Response(REPLY, media_type=STREAM)

    app.add_route("/", answer, methods=["POST"])
    _uvicorn(app, listener, "httptools")


def _uvicorn(app: Any, listener: socket.socket, parser: Any) -> None:
    import uvicorn

    config = uvicorn.Config(
        app, loop="uvloop", http=parser, log_level="error", access_log=False, lifespan="off", timeout_keep_alive=3600
    )
    uvicorn.Server(config).run(sockets=[listener])


def _on_hypercorn(listener: socket.socket) -> None:
    from hypercorn.asyncio import serve
    from hypercorn.config import Config

    config = Config()
    config.bind, config.loglevel, config.keep_alive_timeout = [f"fd://{listener.fileno()}"], "ERROR", 3600
    import uvloop

    uvloop.run(serve(_asgi, config, shutdown_trigger=asyncio.Event().wait))


def _on_granian(listener: socket.socket) -> None:
    import logging

    from granian.constants import Interfaces
    from granian.server.embed import Server

    port = listener.getsockname()[1]
    listener.close()
    logging.disable(logging.CRITICAL)
    asyncio.run(Server(_asgi, port=port, interface=Interfaces.ASGI, log_enabled=False).serve())


def _on_aiohttp(listener: socket.socket) -> None:
    from aiohttp import web

    async def answer(request: web.Request) -> web.Response:
        _use(await request.read())
        return web.Response(body=REPLY, content_type=STREAM)

    app = web.Application(client_max_size=1 << 26)
    app.router.add_post("/", answer)
    import uvloop

    web.run_app(app, sock=listener, print=None, access_log=None, loop=uvloop.new_event_loop())


def _on_cheroot(listener: socket.socket) -> None:
    from cheroot.wsgi import Server

    port = listener.getsockname()[1]
    listener.close()
    Server(("127.0.0.1", port), _wsgi, timeout=3600).start()


def _on_waitress(listener: socket.socket) -> None:
    from waitress import serve

    serve(_wsgi, sockets=[listener], inbuf_overflow=1 << 26, _quiet=True)


def _on_http_server(listener: socket.socket) -> None:
    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True
        wbufsize = -1

        def do_POST(self) -> None:
            body = bytearray(int(self.headers["content-length"]))
            self.rfile.readinto(body)  # type: ignore[attr-defined]
            _use(body)
            self.send_response(200)
            self.send_header("content-type", STREAM)
            self.send_header("content-length", str(len(REPLY)))
            self.end_headers()
            self.wfile.write(REPLY)

        def log_message(self, *_: Any) -> None:
            pass

    _threads(listener, lambda peer: Handler(peer, ("", 0), None))  # type: ignore[arg-type]


def _on_httptools(listener: socket.socket) -> None:
    import httptools

    class Head:
        def __init__(self) -> None:
            self.size, self.done = 0, False

        def on_header(self, name: bytes, value: bytes) -> None:
            if name.lower() == b"content-length":
                self.size = int(value)

        def on_headers_complete(self) -> None:
            self.done = True

    def answer(peer: socket.socket) -> None:
        while data := peer.recv(65536):
            head = Head()
            end = data.find(b"\r\n\r\n") + 4
            httptools.HttpRequestParser(head).feed_data(data[:end])
            body, have = bytearray(head.size), len(data) - end
            view = memoryview(body)
            view[:have] = data[end:]
            while have < head.size:
                have += peer.recv_into(view[have:])
            _use(body)
            peer.sendall(HEAD + REPLY)

    _threads(listener, answer)


def _on_h11(listener: socket.socket) -> None:
    import h11

    def answer(peer: socket.socket) -> None:
        connection = h11.Connection(h11.SERVER)
        while True:
            pieces, event = [], None
            while not isinstance(event, h11.EndOfMessage):
                event = connection.next_event()
                if event is h11.NEED_DATA:
                    connection.receive_data(peer.recv(1 << 18))
                elif isinstance(event, h11.Data):
                    pieces.append(event.data)
                elif isinstance(event, h11.ConnectionClosed):
                    return
            _use(b"".join(pieces))
            headers = [("content-type", STREAM), ("content-length", str(len(REPLY)))]
            said = [h11.Response(status_code=200, headers=headers), h11.Data(REPLY), h11.EndOfMessage()]
            peer.sendall(b"".join(connection.send(one) or b"" for one in said))
            connection.start_next_cycle()

    _threads(listener, answer)


def _threads(listener: socket.socket, answer: Callable[[socket.socket], Any]) -> None:
    while True:
        peer, _ = listener.accept()
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        Thread(target=answer, args=(peer,), daemon=True).start()


SERVERS: Final[dict[str, tuple[str, Callable[[socket.socket], None]]]] = {
    "FastAPI on uvicorn": ("fastapi", _on_fastapi),
    "uvicorn, raw ASGI, httptools": ("uvicorn", lambda listener: _uvicorn(_asgi, listener, "httptools")),
    "uvicorn, raw ASGI, h11": ("uvicorn", lambda listener: _uvicorn(_asgi, listener, "h11")),
    "hypercorn, raw ASGI": ("hypercorn", _on_hypercorn),
    "granian, raw ASGI": ("granian", _on_granian),
    "aiohttp server": ("aiohttp", _on_aiohttp),
    "cheroot, WSGI": ("cheroot", _on_cheroot),
    "waitress, WSGI": ("waitress", _on_waitress),
    "http.server, threads": ("", _on_http_server),
    "h11, threads": ("h11", _on_h11),
    "httptools, threads": ("httptools", _on_httptools),
}
"""Name -> the package, and what serves on a bound socket for ever."""
