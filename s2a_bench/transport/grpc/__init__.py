"""gRPC as lerobot's policy server speaks it (async inference): an observation goes up, a chunk of actions comes back.

Client only: lerobot's server unpickles what any client sends (CVE-2026-25874). Its answers are pickles too, which are
read without unpickling (`pickles`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import GET_ACTIONS_MS, PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.options import option
from s2a_bench.transport import ACTIONS, Capabilities, Choice, Client, Transport, Urls, Wiring
from s2a_bench.transport.defaults import BESIDE
from s2a_bench.transport.listening import UrlOptions
from s2a_bench.transport.observation import TemplateName, names, template_of

LEROBOT = "lerobot"
PACKAGES = ("grpc",)
"""What the extra brings, by the name under which it is imported."""
PAYLOAD_DOWN_BYTES = Fact("payload_down_bytes", "bytes", "what the chunk weighs on the wire")


class GrpcOptions(UrlOptions):
    """The options of the client of lerobot's policy server."""

    SCHEMES: ClassVar[tuple[str, ...]] = ("grpc",)
    ENDS_WITH_PORT: ClassVar[bool] = True

    policy_type: str = option("", "the policy that the server loads: act, smolvla, diffusion, pi0, pi05, groot, ...")
    pretrained: str = option("", "its checkpoint: a path on the server's machine, or a name on its hub")
    device: str = option("cpu", "the server's device for the policy: cpu, cuda, mps")
    actions_per_chunk: int = option(50, "most actions of a chunk that the server returns", ge=1, le=500)
    template: TemplateName = option(LEROBOT, "the observation: a template's name, or a TOML or JSON file", names=names)


class Grpc(Transport[GrpcOptions]):
    """lerobot's policies over gRPC."""

    name = "grpc"
    options = GrpcOptions
    variants = (LEROBOT,)
    payloads = ("raw",)
    answer_kinds = (ACTIONS,)
    stages: ClassVar[dict[str, str]] = {"pickle_pack": "pack", "send": "network", "pickle_parse": "parse"}
    urls = Urls(GrpcOptions.SCHEMES, examine="s2a_bench.transport.grpc.risks:examine")
    compared_with = BESIDE
    facts = (PAYLOAD_BYTES, PAYLOAD_DOWN_BYTES, RECONNECTS, GET_ACTIONS_MS)
    order = 24
    style = {LEROBOT: ("#01665E", "-")}
    packages = ("grpcio",)

    def client(self, wiring: Wiring[GrpcOptions], alive: Callable[[], bool]) -> Client:  # noqa: ARG002
        """Prepare to ask the server at ``wiring.address``, a URL."""
        extras.need(LEROBOT, *PACKAGES)
        from s2a_bench.transport.grpc.client import GrpcClient

        return GrpcClient(wiring)

    def capabilities(self, choice: Choice[GrpcOptions]) -> Capabilities[GrpcOptions]:
        accepts_state = template_of(choice.options.template).accepts_state
        return Capabilities(choice.options, self.payloads, self.answer_kinds, accepts_state, self.facts)

    def require(self, choice: Choice[GrpcOptions]) -> None:
        """Refuse a choice without a server or a policy, and a template for other pictures; raises MissingExtra too."""
        options = choice.options
        if not options.url:
            raise UsageError(
                f"`transport` {self.name}/{LEROBOT} is a client alone; name its server: `url` grpc://HOST:PORT"
            )
        if not (options.policy_type and options.pretrained):
            raise UsageError(
                "`pretrained`: lerobot's server loads what its client names; give `policy_type` and `pretrained`"
            )
        extras.need(LEROBOT, *PACKAGES)
        template = template_of(options.template)
        template.check_pictures(choice.cameras)
        template.check_server(self.name, ())


GRPC = Grpc()
