"""ZeroMQ and MessagePack as GR00T's policy servers speak it: an observation goes up, a chunk of actions comes back.

Our server answers either layout, N1.5 or N1.6, and GR00T's own clients; our client asks foreign servers too, which are
told what a template says (`transport.observation`). GR00T N1 unpickled what it received, so that a client could run any
code in it: nothing here does, and whoever still serves it should not let others reach it.
"""

from __future__ import annotations

from collections.abc import Callable

from s2a_bench import extras
from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS
from s2a_bench.transport import ACTIONS, Client, Handler, Server, Wiring
from s2a_bench.transport.listening import Listening
from s2a_bench.transport.zmq.options import ZmqOptions

GR00T = "gr00t"
PACKAGES = ("msgpack", "zmq")
"""What the extra of its name brings, by the names under which they are imported."""


class Zmq(Listening[ZmqOptions]):
    """Policies over ZeroMQ."""

    name = "zmq"
    options = ZmqOptions
    variants = (GR00T,)
    payloads = ("raw", "jpeg", "jpeg-preencoded", "png")
    schemes = ZmqOptions.SCHEMES
    examines = "s2a_bench.transport.zmq.dangers:examine"
    stages = {"msgpack_pack": "pack", "msgpack_parse": "parse"}
    tells = (PAYLOAD_BYTES, RECONNECTS)
    order = 22
    looks = {GR00T: ("#8C510A", "-")}
    compared_with = ("ros", "loopback")
    packages = ("msgpack", "pyzmq")
    elsewhere = ("url",)
    serving = {"port": 5555}

    def client(self, wiring: Wiring[ZmqOptions], alive: Callable[[], bool]) -> Client:
        """Prepare to ask the server at ``wiring.address``, a URL."""
        extras.need(self.name, *PACKAGES)
        from s2a_bench.transport.zmq.client import ZmqClient

        return ZmqClient(wiring, alive)

    def server(self, wiring: Wiring[ZmqOptions], handler: Handler) -> Server:
        """Bind ``host:port``; raises PortInUse."""
        extras.need(self.name, *PACKAGES)
        from s2a_bench.transport.zmq.server import ZmqServer

        return ZmqServer(wiring, handler)

    def travels(self, variant: str, options: ZmqOptions) -> tuple[str, ...]:  # noqa: ARG002 - of all transports
        """Return what a policy takes: pixels, unless its template says that it decodes files."""
        from s2a_bench.transport.observation import template_of

        if template_of(options.told_by).encoded:
            return self.payloads[1:]
        return self.payloads[:1] if options.url else self.payloads

    def answers(self, variant: str, options: ZmqOptions) -> tuple[str, ...]:  # noqa: ARG002 - of all transports
        """Return actions, which policies answer with."""
        return (ACTIONS,)

    def takes_state(self, variant: str, options: ZmqOptions) -> bool:  # noqa: ARG002 - of all transports
        """Whether the template has a place for the robot's state."""
        from s2a_bench.transport.observation import template_of

        return template_of(options.told_by).takes_state

    def check(self, variant: str, options: ZmqOptions, *, mode: str, engine: str) -> None:  # noqa: ARG002
        """Refuse a key that is not there; raises MissingExtra too."""
        from s2a_bench.transport.credentials import read_key

        extras.need(self.name, *PACKAGES)
        read_key(options.api_key_env)

    def ready(self, wiring: Wiring[ZmqOptions], address: str) -> str:
        """Return where policies are asked, and by whom."""
        key, everybody = wiring.options.api_key_env, wiring.options.no_auth
        whom = f" for who sends the key in ${key}" if key else " for all who reach it" * everybody
        return f"serving GR00T's protocol at {address}{whom}"


ZMQ = Zmq()
