"""ROS 2-native: pictures and tokens as topics or actions under real ROS 2 names and types."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain, count
from pkgutil import resolve_name
from secrets import token_hex
from typing import cast

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import CAMERA_FACTS, PAYLOAD_BYTES, Fact
from s2a_bench.ros import MIDDLEWARES, loss_advice
from s2a_bench.ros.config import domain_id
from s2a_bench.ros.join import PLACES
from s2a_bench.transport import ACTIONS, TOKENS, Capabilities, Choice, Client, Transport, Urls, Wiring
from s2a_bench.transport.ros.options import NAMESPACE, RosOptions

TOPIC, ACTION = VARIANTS = ("topic", "action")
UNREADABLE_N = Fact(
    "unreadable_n", "messages", "of other nodes, that could not be read while the request was under way"
)


class Ros(Transport[RosOptions]):
    name = "ros"
    options = RosOptions
    variants = VARIANTS
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    answer_kinds = (TOKENS, ACTIONS)
    accepts_state = True
    stages = {
        "cdr_pack": "pack",
        "accept": "network",  # an action's goal is accepted before work starts
        "cdr_parse": "parse",
    }
    facts = (PAYLOAD_BYTES, *CAMERA_FACTS, UNREADABLE_N)
    order = 20
    style = {TOPIC: ("#0072B2", "-"), ACTION: ("#56B4E9", "--")}
    packages = (*(package for _, kind in MIDDLEWARES.loaded() for package in kind.packages), "rosbags")
    checks = {
        "rmem-max": "s2a_bench.machine.doctor.host:rmem_max",
        "dds": "s2a_bench.transport.ros.checks:dds",
        "ros": "s2a_bench.transport.ros.checks:ros",
        "middleware": "s2a_bench.transport.ros.checks:middleware",
        **{code: check for _, kind in MIDDLEWARES.loaded() for code, check in kind.checks.items()},
        "dds-buffers": "s2a_bench.transport.ros.checks:buffers",
    }
    udp_checks = ("rmem-max",)
    urls = Urls(("ros",))
    server_class = "s2a_bench.transport.ros.server:RosServer"

    def client(self, wiring: Wiring[RosOptions], alive: Callable[[], bool]) -> Client:
        kind = "action:GenerateClient" if wiring.variant == ACTION else "topic:TopicClient"
        return cast("Client", resolve_name(f"s2a_bench.transport.ros.{kind}")(wiring, alive))

    def measured(self, choice: Choice[RosOptions]) -> Sequence[str]:
        return (ACTION,) if choice.options.action else super().measured(choice)

    def capabilities(self, choice: Choice[RosOptions]) -> Capabilities[RosOptions]:
        """Return the capabilities that llama_msgs has fields for: no actions or state, in a goal sensor_msgs/Image."""
        can = super().capabilities(choice)
        if choice.variant != ACTION:
            return can
        payloads = self.payloads[:2] if choice.mode == "request" else self.payloads
        return replace(can, payloads=payloads, answer_kinds=(TOKENS,), accepts_state=False)

    def require(self, choice: Choice[RosOptions]) -> None:
        """Raise UsageError for options of another middleware or variant, and for a stream to an external server."""
        variant, options = choice.variant, choice.options
        domain_id(os.environ)
        if options.kind.extra:
            extras.need(options.kind.extra, options.kind.module)
        own = options.kind.meeting_place
        for name, at in PLACES.items():
            if getattr(options, at.option) and not (own and own.option == at.option):
                raise UsageError(f"`{at.option}` is {name.title()}'s: choose `middleware` {name}, or leave it out")
        if options.action and variant != ACTION:
            raise UsageError(f"`action` is spoken by ros/{ACTION}, not by ros/{variant}")
        if options.action and choice.mode == "stream":
            raise UsageError("`action`: `mode` stream needs our own server, which keeps the camera's newest frame")

    def tuned(self, options: RosOptions) -> bool:
        return options.dds_tuning == "tuned"

    def datagrams(self, options: RosOptions) -> bool:
        return not loss_advice(options.kind.dds_in(os.environ))

    def against_loss(self, options: RosOptions) -> str:
        from s2a_bench.transport.ros.checks import against_loss

        return against_loss(options.kind.dds_in(os.environ), os.environ)

    def addresses(self, options: RosOptions) -> Iterable[str]:
        """Return the namespace, then it with a number; a new random one without the option."""
        if not options.namespace:
            return (f"{NAMESPACE}_{token_hex(4)}",)
        return chain([options.namespace], (f"{options.namespace}_{number}" for number in count(2)))

    def ready(self, wiring: Wiring[RosOptions]) -> str:
        from s2a_bench.ros.llama import GENERATE_RESPONSE
        from s2a_bench.transport.ros.camera import CAMERA
        from s2a_bench.transport.ros.checks import hint
        from s2a_bench.transport.ros.joining import AT, place_of, remapped

        kind, names = wiring.options.kind, remapped(wiring)
        namespace, hosted, _ = wiring.address.partition(AT)
        action, camera = (names.get(name, name) for name in (f"{namespace}/generate_response", namespace + CAMERA))
        served = f"action {action}" if kind.builds(GENERATE_RESPONSE) else f"topics below {namespace}"
        where = place_of(wiring) + (", which this server is" if hosted else "")
        room = hint(kind.dds_in(os.environ), os.environ)
        return f"serving {served}, camera {camera}, in {where}{room and f'; for large pictures: {room}'}"


ROS = Ros()
