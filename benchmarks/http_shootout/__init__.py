"""Which HTTP server and client carry a picture fastest? One interleaved run of well-kept libraries.

Every server takes a POST of raw ``bgr8`` pixels, turns them into RGB as `http/binary` does, and answers with one small
event; every client sends the picture and reads the answer, on a kept connection. Servers are compared with one lean
client, clients with one lean server; libraries that are not installed are left out.

    python -m benchmarks.http_shootout [--size 640x480] [--rounds 150]
"""

from __future__ import annotations

from typing import Final

REPLY: Final = b'data: {"choices":[{"index":0,"delta":{"content":"go"},"token":1}]}\n\n'
STREAM: Final = "text/event-stream"
