"""What a request of a client may cost: its pixels together."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.frames.convert import encode_png
from s2a_bench.plugins.policy_servers.observed import read_observation
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Trace
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import of_json, of_picture
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.ros.camera import pictures_of

PNG = bytes(encode_png(np.zeros((10, 10, 3), np.uint8)))


def with_bodies(count: int, pixels: int) -> int:
    """Read a request of pictures of 10x10 pixels as the body; return how many it has."""
    fields = {"pictures": [["image/png", len(PNG)]] * count}
    headers = [(native.PARAMETERS_HEADER, json.dumps(fields))]
    request, _ = of_picture(headers, PNG * count, Trace(), LIMITS.but(pixels=pixels))
    return len(request.images)


def with_uris(count: int, pixels: int) -> int:
    url = {"url": f"data:image/png;base64,{b64encode(PNG).decode()}"}
    message = {"role": "user", "content": [{"type": "image_url", "image_url": url}] * count}
    request, _ = of_json([], json.dumps({"messages": [message]}).encode(), Trace(), LIMITS.but(pixels=pixels))
    return len(request.images)


def over_ros(count: int, pixels: int) -> int:
    message = ros.compressed_image_message(np.frombuffer(PNG, np.uint8), 1, "camera", "png")
    return len(pictures_of([message] * count, Trace(), LIMITS.but(pixels=pixels)))


def in_an_observation(count: int, pixels: int) -> int:
    return len(read_observation({"a": [PNG] * count}, Trace(), LIMITS.but(pixels=pixels))[0])


@pytest.mark.parametrize("read", [with_bodies, with_uris, over_ros, in_an_observation])
def test_the_pictures_of_a_request_share_its_pixels(read: Callable[..., int]) -> None:
    assert read(3, pixels=300) == 3
    with pytest.raises(RequestFailed, match="a picture of 10x10; at most 99 pixels are taken"):
        read(3, pixels=299)
