"""ROS 2-native: pictures and tokens as topics or actions under real ROS 2 names and types."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from secrets import token_hex

from s2a_bench.errors import UsageError
from s2a_bench.facts import CAMERA_AGE_MS, CAMERA_FRAMES, CAMERA_STAMP_AGE_MS, PAYLOAD_BYTES, STALE_FRAMES, Fact
from s2a_bench.ros.router import ROUTER
from s2a_bench.transport import ACTIONS, TOKENS, Client, Handler, Server, Transport, Wiring
from s2a_bench.transport.ros.options import NAMESPACE, RosOptions

TOPIC, ACTION = VARIANTS = ("topic", "action")
UNREADABLE_N = Fact("unreadable_n", "messages", "of strangers, that could not be read while the request was under way")
LARGE_PICTURE = 640 * 480
"""Pixels above which DDS needs more receive buffer than Linux gives by default."""


class Ros(Transport[RosOptions]):
    """Messages of sensor_msgs and s2a_msgs over a middleware, or the action of llama_ros."""

    name = "ros"
    options = RosOptions
    variants = VARIANTS
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    stages = {
        "cdr_pack": "pack",
        "accept": "network",  # an action's goal is accepted before work starts
        "cdr_parse": "parse",
    }
    tells = (PAYLOAD_BYTES, CAMERA_FRAMES, CAMERA_AGE_MS, CAMERA_STAMP_AGE_MS, STALE_FRAMES, UNREADABLE_N)
    order = 20
    looks = {TOPIC: ("#0072B2", "-"), ACTION: ("#56B4E9", "--")}
    packages = ("cyclonedds", "eclipse-zenoh", "rosbags")
    checks = {
        "rmem-max": "s2a_bench.machine.doctor.robot:rmem_max",
        "dds": "s2a_bench.transport.ros.checks:dds",
        "ros": "s2a_bench.transport.ros.checks:ros",
        "middleware": "s2a_bench.transport.ros.checks:middleware",
        "zenoh": "s2a_bench.transport.ros.checks:zenoh",
        "dds-buffers": "s2a_bench.transport.ros.buffers:check",
    }
    watches_udp = True
    elsewhere = ("action",)
    serving = {
        "namespace": "/llama",
        "router": ROUTER,
        "qos": "sensor_data",  # matches reliable cameras as well as best-effort ones
        "feedback_interval": 0.002,
        "max_tokens": 512,
        "publish_tokens": True,
        "node_api": True,
    }

    def client(self, wiring: Wiring[RosOptions], alive: Callable[[], bool]) -> Client:
        """Join the domain and wait for the server under the namespace ``wiring.address``."""
        if wiring.variant == ACTION:
            from s2a_bench.transport.ros.action import GenerateClient

            return GenerateClient(wiring, alive)
        from s2a_bench.transport.ros.topic import TopicClient

        return TopicClient(wiring, alive)

    def server(self, wiring: Wiring[RosOptions], handler: Handler) -> Server:
        """Join the domain alone under the namespace; one server answers both variants."""
        from s2a_bench.transport.ros.server import RosServer

        return RosServer(wiring, handler)

    def measured(self, options: RosOptions, chosen: Sequence[str], engine: str) -> Sequence[str]:  # noqa: ARG002
        """Return topics unless told, and of somebody else's node its action."""
        return (ACTION,) if options.action else chosen or (TOPIC,)

    def answers(self, variant: str, options: RosOptions) -> tuple[str, ...]:  # noqa: ARG002 - of all transports
        """Return tokens alone for the action: llama_msgs has no field for a robot's."""
        return (TOKENS,) if variant == ACTION else (TOKENS, ACTIONS)

    def takes_state(self, variant: str, options: RosOptions) -> bool:  # noqa: ARG002 - of all transports
        """Whether it is the topic: a goal of llama_msgs has no field for it."""
        return variant == TOPIC

    def check(self, variant: str, options: RosOptions, *, mode: str, engine: str) -> None:  # noqa: ARG002
        """Refuse what a goal cannot carry, and a stream that nobody keeps."""
        from s2a_bench.ros.config import domain_id
        from s2a_bench.transport.ros.joining import is_routed

        domain_id(os.environ)
        if options.router and not is_routed(options):
            raise UsageError("`router` is Zenoh's: choose `middleware` zenoh, or leave it out")
        if options.action and variant != ACTION:
            raise UsageError(f"`action` is spoken by ros/{ACTION}, not by ros/{variant}")
        if options.action and mode == "stream":
            raise UsageError("`action`: `mode` stream needs our own server, which keeps the camera's newest frame")
        if variant == ACTION and mode == "request" and options.payload not in {"raw", "yuyv"}:
            raise UsageError(
                f"`payload`: a goal carries sensor_msgs/Image, not {options.payload}; say it for this transport alone: "
                f"ros/{ACTION}?payload=raw"
            )

    def tuned(self, options: RosOptions) -> bool:
        """Return False for DDS, and processes, as they come."""
        return options.dds_tuning == "tuned"

    def foreign(self, options: RosOptions) -> str:
        """Return the name of somebody else's action."""
        return options.action

    def bind(self, options: RosOptions, taken: Sequence[str]) -> str:
        """Return the namespace, with a number where another server of ours has it; unless told, one nobody else has."""
        if not options.namespace:
            return f"{NAMESPACE}_{token_hex(4)}"
        numbered = (f"{options.namespace}_{number}" for number in count(2))
        return options.namespace if options.namespace not in taken else next(n for n in numbered if n not in taken)

    def before_run(self, width: int, height: int) -> tuple[str, ...]:
        """Return the check of the receive buffer, where pictures are large."""
        return ("rmem-max",) if width * height > LARGE_PICTURE else ()

    def against_loss(self, options: RosOptions) -> str:
        """Return what the middleware in use needs."""
        from s2a_bench.transport.ros.buffers import against_loss

        return against_loss(options.middleware, os.environ)

    def ready(self, wiring: Wiring[RosOptions], address: str) -> str:
        """Return the names of action and camera."""
        from s2a_bench.transport.ros.camera import CAMERA
        from s2a_bench.transport.ros.joining import AT, place_of, remapped

        names = remapped(wiring)
        namespace, hosted, _ = address.partition(AT)
        action, camera = (names.get(name, name) for name in (f"{namespace}/generate_response", namespace + CAMERA))
        where = place_of(replace(wiring, address=address)) + (", which this server is" if hosted else "")
        return f"serving action {action}, camera {camera}, in {where}"


ROS = Ros()
