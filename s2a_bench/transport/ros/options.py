"""What the ROS transport can be told."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator

from s2a_bench.transport.options import SERVER, Options

NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
"""ROS 2's rules for an absolute name."""


class RosOptions(Options):
    """Where topics and actions are, and what carries them."""

    action: str = Field(
        "",
        description="an action that runs already, as /llama/generate_response of llama_ros (a black box)",
        json_schema_extra=SERVER,
    )
    namespace: str = Field("/s2a_bench", description="namespace of the topics", json_schema_extra=SERVER)
    domain_id: int | None = Field(
        None, ge=0, le=232, description="DDS domain [default: ROS_DOMAIN_ID, else 0]", json_schema_extra=SERVER
    )
    middleware: str = Field(
        "", description="cyclonedds, rclpy [default: rclpy in a sourced ROS 2 environment]", json_schema_extra=SERVER
    )
    qos: Literal["reliable", "sensor_data"] = Field(
        "reliable", description="quality of service of the camera topic", json_schema_extra=SERVER
    )
    dds_tuning: Literal["tuned", "default"] = Field(
        "tuned", description="large datagrams and receive buffers, or DDS as it comes", json_schema_extra=SERVER
    )
    result_timeout: float = Field(
        60.0, ge=0, le=86_400, description="seconds an action's result is kept", json_schema_extra=SERVER
    )
    max_tokens: int | None = Field(
        None,
        ge=1,
        le=2**20,
        description="most tokens of a goal, which cannot say how many it wants [default: the run's]",
        json_schema_extra=SERVER,
    )
    feedback_interval: float = Field(
        0.0, ge=0, le=60, description="seconds: tokens that come faster share a feedback", json_schema_extra=SERVER
    )
    publish_tokens: bool = Field(
        False, description="also publish the tokens of goals, for plotting", json_schema_extra=SERVER
    )

    @field_validator("namespace", "action")
    @classmethod
    def _is_a_name(cls, text: str) -> str:
        if text and not NAME.fullmatch(text):
            raise ValueError(f"'{text}' should look like /name or /name/name: letters, digits, underscores")
        return text

    @field_validator("middleware")
    @classmethod
    def _is_known(cls, name: str) -> str:
        from s2a_bench.ros import MIDDLEWARES

        if name and name not in MIDDLEWARES:
            raise ValueError(f"'{name}' is none of {', '.join(MIDDLEWARES)}")
        return name
