"""What a foreign policy server over ZeroMQ does that is dangerous: it is sent a ping, which asks nothing of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from urllib.parse import SplitResult, urlunsplit

from s2a_bench import extras
from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.bounds import Bounds
from s2a_bench.transport.dangers import PATIENCE_S, for_anybody, shown
from s2a_bench.transport.zmq import PACKAGES

PORT = 5555
"""Where GR00T's servers listen unless told."""


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Ping it without a key."""
    extras.need("zmq", *PACKAGES)
    place = f"{parts.hostname}:{parts.port or PORT}"
    try:
        said = _pinged(urlunsplit((parts.scheme, place, "", "", "")))
    except ServerDied as error:
        raise OSError(str(error)) from error
    if said:
        yield Finding("server", "state", f"it answers, and tells nobody without a key anything: {shown(said)}")
    else:
        yield for_anybody(
            parts,
            "it answers everybody's ping; if it is GR00T's, everybody moves the robot, and ends the server by `kill`, "
            "which is not tried here",
            "let it listen on 127.0.0.1 alone (GR00T's listens on all unless told), reach it by ssh -L, give it an "
            "api_token",
        )
    yield Finding(
        "pickle",
        "advice",
        "GR00T N1 unpickles what anybody sends, so that who reaches the port runs code there; N1.5 and later do not, "
        "and no ping tells them apart",
        "look at which version serves; s2a-bench does not speak N1's protocol",
    )


def _pinged(url: str) -> str:
    """Return the error that a server answers a ping with, "" for none."""
    from s2a_bench.transport.zmq import own
    from s2a_bench.transport.zmq.client import Link
    from s2a_bench.transport.zmq.wire import pack, unpack

    bounds = Bounds(url, 2 * PATIENCE_S, 0)
    with closing(Link(url, PATIENCE_S, lambda: True)) as link:
        link.greet(bounds)
        answer = unpack(link.asked(pack({own.ENDPOINT: own.PING}), bounds))
    if not isinstance(answer, dict):
        raise RequestFailed(f"{url} answers a ping with {type(answer).__name__}, which GR00T's servers do not")
    return str(answer[own.ERROR]) if own.ERROR in answer else ""
