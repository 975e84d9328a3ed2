"""gRPC as lerobot's policy server speaks it (async inference): an observation goes up, a chunk of actions comes back.

Client only: lerobot's server unpickles what any client sends (CVE-2026-25874). Its answers are pickles too, which are
read without unpickling (`pickles`).
"""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.facts import PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.options import option
from s2a_bench.plugins.policy_servers.grpc.pickles import observation_of
from s2a_bench.plugins.policy_servers.policies import PolicyTransport, TemplateOptions
from s2a_bench.transport import Choice, Sleep, Urls

LEROBOT = "lerobot"
GET_ACTIONS_MS = Fact("get_actions_ms", "ms", "lerobot's call `GetActions`, which begins before the observation leaves")
PAYLOAD_DOWN_BYTES = Fact("payload_down_bytes", "bytes", "what the chunk weighs on the wire")


class GrpcOptions(TemplateOptions):
    SCHEMES: ClassVar[tuple[str, ...]] = ("grpc",)
    ENDS_WITH_PORT: ClassVar[bool] = True

    policy_type: str = option("", "the policy that the server loads: act, smolvla, diffusion, pi0, pi05, groot, ...")
    pretrained: str = option("", "its checkpoint: a path on the server's machine, or a name on its hub")
    device: str = option("cpu", "the server's device for the policy: cpu, cuda, mps")
    actions_per_chunk: int = option(50, "most actions of a chunk that the server returns", ge=1, le=500)


class Grpc(PolicyTransport[GrpcOptions]):
    name = "grpc"
    options = GrpcOptions
    variants = (LEROBOT,)
    usual_template = LEROBOT
    serves = False
    payloads = ("raw",)
    stages: ClassVar[dict[str, str]] = {"pickle_pack": "pack", "send": "network", "pickle_parse": "parse"}
    urls = Urls(
        GrpcOptions.SCHEMES,
        examine="s2a_bench.plugins.policy_servers.grpc.client:examine",
        unpickles="lerobot's server unpickles what any client sends (CVE-2026-25874)",
    )
    needs = ("grpc", "grpc", "hpack", "hyperframe")
    client_class = "s2a_bench.plugins.policy_servers.grpc.client:GrpcClient"
    reader = "s2a_bench.plugins.policy_servers.grpc.tap:GrpcReader"
    facts = (PAYLOAD_BYTES, PAYLOAD_DOWN_BYTES, RECONNECTS, GET_ACTIONS_MS)
    order = 24
    style = {LEROBOT: ("#01665E", "-")}
    packages = ("grpcio",)
    sleep = Sleep(
        GET_ACTIONS_MS,
        1e3 / 30,
        "start lerobot's server with --inference_latency=0; with that, its policy takes this time itself",
    )

    def require(self, choice: Choice[GrpcOptions]) -> None:
        """Refuse a choice without a policy, and an observation that lerobot does not take."""
        options = choice.options
        if not (options.policy_type and options.pretrained):
            raise UsageError(
                "`pretrained`: lerobot's server loads what its client names; give `policy_type` and `pretrained`"
            )
        super().require(choice)
        template = self.template(options)
        observation_of(template.check_request(choice.cameras, choice.state), template.name)


GRPC = Grpc()
