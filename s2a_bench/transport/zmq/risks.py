"""What a foreign policy server over ZeroMQ does that is dangerous: from its answers to two harmless requests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from urllib.parse import SplitResult, urlunsplit

from s2a_bench import extras
from s2a_bench.errors import RequestFailed
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.listening import in_url
from s2a_bench.transport.risks import PATIENCE_S, no_key, printable
from s2a_bench.transport.zmq import PACKAGES, layouts

PORT = 5555
"""The default port of GR00T's servers."""
N1 = b"ERROR", b"PK\x03\x04", *(bytes((0x80, protocol)) for protocol in range(2, 6))
"""How answers of GR00T N1 begin: its only error, which MessagePack is to it, an archive of torch.save, a pickle."""


def examine(parts: SplitResult) -> Iterator[Finding]:
    """Ping it without a key; if it answers, read how its configurations are marked."""
    extras.need("zmq", *PACKAGES)
    from s2a_bench.transport.zmq.client import ReqSocket
    from s2a_bench.transport.zmq.wire import pack, read

    url = urlunsplit((parts.scheme, f"{in_url(parts.hostname or '')}:{parts.port or PORT}", "", "", ""))
    bounds = Bounds(url, 3 * PATIENCE_S, 0)
    with closing(ReqSocket(url, PATIENCE_S, lambda: True)) as link:
        link.greet(bounds)
        pong = link.exchange(pack({layouts.ENDPOINT: layouts.PING}), bounds)
        if pong.startswith(N1):
            yield _unpickles_all()
            return
        answer, marks = read(pong)
        if not isinstance(answer, dict):
            raise RequestFailed(f"{url} answers a ping with {type(answer).__name__}, which GR00T's servers do not")
        if layouts.ERROR in answer:
            error = printable(str(answer[layouts.ERROR]))
            yield Finding("server", "state", f"it answers, and refuses requests without a key: {error}")
        else:
            yield no_key(
                parts,
                "it answers any client's ping; if it is GR00T's, any client can move the robot, and end the server by "
                "`kill`, which is not tried here",
                "let it listen on 127.0.0.1 alone (GR00T's default is all interfaces), reach it by ssh -L, give it an "
                "api_token",
            )
            _, marks = read(link.exchange(pack({layouts.ENDPOINT: layouts.MODALITIES}), bounds))
    yield _may_unpickle(marks)


def _unpickles_all() -> Finding:
    return Finding(
        "pickle",
        "warning",
        "it answers a ping as GR00T N1 does, which unpickles (torch.load) what any client sends: a client that reaches "
        "the port runs code there",
        "serve N1.5 or later; until then let it listen on 127.0.0.1 alone, and reach it by ssh -L; s2a-bench does not "
        "speak N1's protocol",
    )


def _may_unpickle(marks: set[str]) -> Finding:
    if marks & {layouts.N1_5, layouts.N1_6}:
        return Finding("pickle", "state", "its configurations are marked as N1.5's or N1.6's: they unpickle nothing")
    which = "its configurations are marked as GR00T N1.7's" if marks else "no answer tells which GR00T it is"
    return Finding(
        "pickle",
        "advice",
        f"{which}: early N1.7 servers unpickle arrays of kind O, so that a client that reaches the port runs code "
        "there; later ones refuse them, N1.5 and N1.6 unpickle nothing",
        "update its gr00t to a version that refuses arrays of kind O",
    )
