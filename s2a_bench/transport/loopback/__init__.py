"""The pipeline without a wire: the floor that other transports are compared with."""

from __future__ import annotations

from s2a_bench.transport import ACTIONS, TOKENS, Transport, TransportOptions


class Loopback(Transport[TransportOptions]):
    """A call within the process; no picture is sent, whatever the payload is."""

    name = "loopback"
    options = TransportOptions
    answer_kinds = (TOKENS, ACTIONS)
    accepts_state = True
    stages = {"hand_over": "parse"}  # making of the request what the handler takes
    order = 100
    style = {"": ("#009E73", ":")}
    compared_with = ()
    in_process = True
    crosses_links = False
    client_class = "s2a_bench.transport.loopback.in_process:LoopbackClient"
    server_class = "s2a_bench.transport.loopback.in_process:LoopbackServer"


LOOPBACK = Loopback()
