"""The action of llama_ros: goals, feedback and results of ``llama_msgs/action/GenerateResponse``, in two versions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from s2a_bench.errors import UsageError
from s2a_bench.ros.messages import DEFAULT_VERSION, default

GENERATE_RESPONSE = "llama_msgs/action/GenerateResponse"
DRY_SEQUENCE_BREAKERS = ("\\n", ":", '\\"",', '*"')
"""The texts that rosidl makes of the default ``["\\\\n", ":", "\\\\\\"", "*"]``, as peers without other wishes send."""


def sampling_config(version: str = DEFAULT_VERSION, /, **overrides: Any) -> Any:
    fields = {"dry_sequence_breakers": DRY_SEQUENCE_BREAKERS} | overrides
    return default("llama_msgs/msg/SamplingConfig", version, **fields)


def generate_goal(
    prompt: str,
    images: Sequence[Any] = (),
    *,
    stop: Sequence[str] = (),
    reset: bool = False,
    version: str = DEFAULT_VERSION,
    **sampling: Any,
) -> Any:
    """Build a goal; ``images`` are sensor_msgs/Image, ``sampling`` fields of SamplingConfig such as ``grammar``.

    Raises UsageError for more than one image with llama_msgs 4.4, whose goal holds exactly one (empty for none).
    """
    fields: dict[str, Any] = {"prompt": prompt, "stop": stop, "reset": reset}
    if version == "4.4":
        if len(images) > 1:
            raise UsageError(f"llama_msgs 4.4 takes one image in a goal, not {len(images)}: use 6.0")
        if images:
            fields["image"] = images[0]
    else:
        fields["images"] = images
    return default(GENERATE_RESPONSE + "_Goal", version, **fields, sampling_config=sampling_config(version, **sampling))


def images_of(message: Any) -> list[Any]:
    """Return the images of a goal of either version, an empty one included; other messages have none."""
    if hasattr(message, "images"):
        return list(message.images)
    return [message.image] if hasattr(message, "image") else []


def goal_images(goal: Any) -> list[Any]:
    """Return the images of a goal of either version, empty ones left out."""
    return [image for image in images_of(goal) if image.data.size]


def token_feedback(text: str, token: int, version: str = DEFAULT_VERSION) -> Any:
    partial = default("llama_msgs/msg/PartialResponse", version, text=text, token=token)
    return default(GENERATE_RESPONSE + "_Feedback", version, partial_response=partial)


def text_result(text: str, tokens: Sequence[int] = (), version: str = DEFAULT_VERSION) -> Any:
    response = default("llama_msgs/msg/Response", version, text=text, tokens=tokens)
    return default(GENERATE_RESPONSE + "_Result", version, response=response)
