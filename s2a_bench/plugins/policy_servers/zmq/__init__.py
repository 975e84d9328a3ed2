"""ZeroMQ and MessagePack as GR00T's policy servers speak it: an observation goes up, a chunk of actions comes back.

Our server answers all layouts, N1.5 to N1.7, and GR00T's own clients; our client also queries foreign servers, with
observations from a template (`observation`). GR00T N1 unpickled what it received, and early N1.7 servers
unpickle arrays of kind O, so that a client can run any code in them. Nothing here unpickles, and such a server belongs
where no other client reaches it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS
from s2a_bench.options import option
from s2a_bench.plugins.policy_servers.observation import Template, template_of
from s2a_bench.plugins.policy_servers.policies import PolicyTransport, TemplateOptions
from s2a_bench.transport import SERVER, Urls, Wiring
from s2a_bench.transport.listening import ListeningOptions, ListeningTransport

GR00T = "gr00t"


class ZmqOptions(ListeningOptions, TemplateOptions):
    SCHEMES: ClassVar[tuple[str, ...]] = ("tcp",)
    ENDS_WITH_PORT: ClassVar[bool] = True
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {"port": 5555}

    layout: Literal["auto", "n1.7", "n1.6", "n1.5"] = option(
        "auto",
        "GR00T's form of observations and arrays: n1.7, n1.6, n1.5; auto: by the marks of the server's configurations",
        side=SERVER,
    )


class Zmq(ListeningTransport[ZmqOptions], PolicyTransport[ZmqOptions]):
    name = "zmq"
    options = ZmqOptions
    variants = (GR00T,)
    urls = Urls(
        ZmqOptions.SCHEMES,
        examine="s2a_bench.transport.risks:connect",
        unpickles="GR00T N1 and early N1.7 unpickle what any client sends",
    )
    needs = ("zmq", "msgpack", "zmq")
    client_class = "s2a_bench.plugins.policy_servers.zmq.client:ZmqClient"
    server_class = "s2a_bench.plugins.policy_servers.zmq.server:ZmqServer"
    reader = "s2a_bench.plugins.policy_servers.zmq.tap:ZmqReader"
    facts = (PAYLOAD_BYTES, RECONNECTS)
    order = 22
    style = {GR00T: ("#8C510A", "-")}
    packages = ("msgpack", "pyzmq")

    def template(self, options: ZmqOptions) -> Template:
        usual = "gr00t-n1.5" if options.layout == "n1.5" else "gr00t-n1.6"
        return template_of(options.template or usual)

    def ready(self, wiring: Wiring[ZmqOptions]) -> str:
        address = wiring.address
        return f"serving GR00T's protocol at {address}{wiring.options.callers('send the key in {}')}"


ZMQ = Zmq()
