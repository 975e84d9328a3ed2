"""The options of the ROS transport."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import create_model, field_validator

from s2a_bench.errors import UsageError
from s2a_bench.options import Names, one_of, option
from s2a_bench.ros import MIDDLEWARES, MiddlewareKind, middleware_kind
from s2a_bench.ros.join import PLACES
from s2a_bench.ros.remap import ABSOLUTE, RULE
from s2a_bench.transport import EXTERNAL, SERVER, SERVING, TransportOptions

NAMESPACE = "/s2a_bench"
"""The default namespace; servers of a run add a random suffix."""

SCHEME = "ros://"
BASE_NAME = r"^[A-Za-z_][A-Za-z0-9_]*$"
"""ROS 2's rules for the name of a node."""


class DomainOptions(TransportOptions):
    """The options that locate a server; the meeting places of middlewares follow."""

    PANEL: ClassVar[str] = "ROS 2"

    action: str = option(
        "",
        "an action that runs already, as /llama/generate_response of llama_ros (a black box)",
        side=EXTERNAL,
    )
    url: str = option("", "our server that runs already, by its namespace, as ros:///llama", side=EXTERNAL, risk="url")
    namespace: str = option("", "namespace of the topics [default: a new one for each run]", side=SERVER, first=True)
    domain_id: int | None = option(None, "DDS domain [default: ROS_DOMAIN_ID, else 0]", ge=0, le=232, side=SERVER)
    middleware: Annotated[str, one_of(lambda: ("", *MIDDLEWARES))] = option(
        "", f"{', '.join(MIDDLEWARES)} [default: a sourced ROS 2's own, else the first installed]", side=SERVER
    )


if TYPE_CHECKING:
    PlaceOptions = DomainOptions
else:
    named = {at.option: (str, option("", at.about, side=SERVER, risk="url")) for at in PLACES.values()}
    PlaceOptions = create_model("PlaceOptions", __base__=DomainOptions, __module__=__name__, **named)


class RosOptions(PlaceOptions):
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {
        "namespace": "/llama",
        **{at.option: at.default for at in PLACES.values()},
        "qos": "sensor_data",  # matches reliable cameras as well as best-effort ones
        "feedback_interval": 0.002,
        "max_tokens": 512,
        "publish_tokens": True,
        "node_api": True,
    }
    NOT_SERVE_FLAGS: ClassVar[tuple[str, ...]] = (
        *("qos", "dds_tuning", "result_timeout", "feedback_interval", "publish_tokens"),
        *("remap", "node_api", "log_level", "max_frame_age", "use_sim_time"),
    )

    qos: Literal["reliable", "sensor_data"] = option(
        "reliable", "the camera topic's: reliable, sensor_data (best effort)", side=SERVER
    )
    max_frame_age: float = option(
        1.0,
        "seconds since a camera topic's frame came: a request without a picture fails if the newest "
        "frame is older, and where a publisher has sent none",
        gt=0,
        le=86_400,
        side=SERVER,
    )
    dds_tuning: Literal["tuned", "default"] = option(
        "tuned", "tuned (large datagrams and receive buffers), default (DDS as it comes)", side=SERVER
    )
    result_timeout: float = option(60.0, "seconds an action's result is kept", ge=0, le=86_400, side=SERVER)
    max_tokens: int | None = option(
        None,
        "most tokens of a goal, which cannot say how many it wants [default: the run's]",
        ge=1,
        le=2**20,
        side=SERVING,
    )
    llama_msgs: Literal["", "4.4", "6.0"] = option(
        "", "version of llama_msgs that the action speaks: 4.4, 6.0 [default: the workspace's, else 6.0]", side=SERVING
    )
    feedback_interval: float = option(
        0.0, "seconds: tokens that come faster share a feedback", ge=0, le=60, side=SERVING
    )
    publish_tokens: bool = option(False, "also publish the tokens of goals, for plotting", side=SERVING)
    camera_topic: str = option(
        "", "the camera's topic; compressed pictures come below it [default: NAMESPACE/camera/image_raw]", side=SERVING
    )
    remap: Names = option((), "topics, services and actions by other names, as FROM:=TO", side=SERVING)
    node_name: str = option("server", "name of the node, below the namespace", side=SERVING, pattern=BASE_NAME)
    node_api: bool = option(False, "have parameters, /rosout and /diagnostics, as ROS 2 nodes do", side=SERVING)
    log_level: Literal["debug", "info", "warn", "error", "fatal"] = option(
        "info", "what /rosout tells: debug, info, warn, error, fatal", side=SERVING
    )

    use_sim_time: bool = option(False, "the stamps of frames are in the time of /clock", side=SERVING)

    @field_validator("remap")
    @classmethod
    def _are_rules(cls, rules: tuple[str, ...]) -> tuple[str, ...]:
        for rule in rules:
            if not RULE.fullmatch(rule):
                raise ValueError(f"'{rule}' should look like from:=to, both names as name, name/name, /name or ~/name")
        return rules

    @field_validator("namespace", "action", "camera_topic")
    @classmethod
    def _is_a_name(cls, text: str) -> str:
        if text and not ABSOLUTE.fullmatch(text):
            raise ValueError(f"'{text}' should look like /name or /name/name: letters, digits, underscores")
        return text

    @field_validator("url")
    @classmethod
    def _names_a_namespace(cls, url: str) -> str:
        if url and not (url.startswith(SCHEME) and ABSOLUTE.fullmatch(url.removeprefix(SCHEME))):
            raise ValueError(f"'{url}' should look like {SCHEME}/llama, with the namespace of the server")
        return url

    def check(self) -> None:
        for at in PLACES.values():
            if place := getattr(self, at.option):
                at.check(place)
        if self.url and self.action:
            raise UsageError("`url` and `action` name two servers; give one of them")

    @property
    def external_address(self) -> str:
        return self.action or self.url.removeprefix(SCHEME)

    @property
    def kind(self) -> MiddlewareKind:
        return middleware_kind(self.middleware)
