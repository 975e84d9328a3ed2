"""The clients of the shoot-out: each asks again and again on one connection."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Callable
from io import BytesIO
from typing import Final

Ask = Callable[[memoryview], bytes]


def _with_httpx(port: int) -> Ask:
    import httpx

    client = httpx.Client(trust_env=False)

    def ask(body: memoryview) -> bytes:
        with client.stream("POST", f"http://127.0.0.1:{port}/", content=bytes(body)) as answer:
            return answer.read()

    return ask


def _with_http_client(port: int) -> Ask:
    connection = http.client.HTTPConnection("127.0.0.1", port)

    def ask(body: memoryview) -> bytes:
        connection.request("POST", "/", body)
        return connection.getresponse().read()

    return ask


def _with_urllib3(port: int) -> Ask:
    import urllib3

    pool = urllib3.HTTPConnectionPool("127.0.0.1", port)
    return lambda body: pool.urlopen("POST", "/", body=bytes(body), preload_content=True).data


def _with_requests(port: int) -> Ask:
    import requests

    session = requests.Session()
    session.trust_env = False
    return lambda body: session.post(f"http://127.0.0.1:{port}/", data=bytes(body)).content


def _with_aiohttp(port: int) -> Ask:
    import aiohttp
    import uvloop

    loop = uvloop.new_event_loop()

    async def opened() -> aiohttp.ClientSession:
        return aiohttp.ClientSession()  # never closed: the process ends

    session = loop.run_until_complete(opened())

    async def post(body: memoryview) -> bytes:
        async with session.post(f"http://127.0.0.1:{port}/", data=bytes(body)) as answer:
            return await answer.read()

    return lambda body: loop.run_until_complete(post(body))


def _with_pycurl(port: int) -> Ask:
    import pycurl

    curl = pycurl.Curl()
    curl.setopt(pycurl.URL, f"http://127.0.0.1:{port}/")
    curl.setopt(pycurl.HTTPHEADER, ["Expect:", "Content-Type: application/octet-stream"])
    curl.setopt(pycurl.POST, 1)
    curl.setopt(pycurl.TCP_NODELAY, 1)
    curl.setopt(pycurl.UPLOAD_BUFFERSIZE, 1 << 21)

    def ask(body: memoryview) -> bytes:
        got = BytesIO()
        curl.setopt(pycurl.POSTFIELDSIZE, len(body))
        curl.setopt(pycurl.POSTFIELDS, bytes(body))
        curl.setopt(pycurl.WRITEFUNCTION, got.write)
        curl.perform()
        return got.getvalue()

    return ask


def _with_h11(port: int) -> Ask:
    import h11

    peer = socket.create_connection(("127.0.0.1", port))
    peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection = h11.Connection(h11.CLIENT)

    def ask(body: memoryview) -> bytes:
        headers = [("host", "a"), ("content-length", str(len(body)))]
        head = connection.send(h11.Request(method="POST", target="/", headers=headers)) or b""
        peer.sendmsg([head])
        for piece in connection.send_with_data_passthrough(h11.Data(body)) or ():  # type: ignore[arg-type]
            peer.sendall(piece)
        connection.send(h11.EndOfMessage())
        got = b""
        while not isinstance(event := connection.next_event(), h11.EndOfMessage):
            if event is h11.NEED_DATA:
                connection.receive_data(peer.recv(65536))
            elif isinstance(event, h11.Data):
                got += event.data
        connection.start_next_cycle()
        return got

    return ask


CLIENTS: Final[dict[str, tuple[str, Callable[[int], Ask]]]] = {
    "httpx": ("httpx", _with_httpx),
    "requests": ("requests", _with_requests),
    "urllib3": ("urllib3", _with_urllib3),
    "aiohttp client": ("aiohttp", _with_aiohttp),
    "pycurl": ("pycurl", _with_pycurl),
    "http.client": ("", _with_http_client),
    "h11 on a socket": ("h11", _with_h11),
}
"""Name -> the package, and what makes one for a port."""
