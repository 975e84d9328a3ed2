"""What a request of a client may cost: its pixels together, and how deep its document goes."""

from __future__ import annotations

import json
from base64 import b64encode

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.frames.convert import encode_png
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Trace
from s2a_bench.transport.http import native
from s2a_bench.transport.http.chat import Reads, of_json, of_picture
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


@pytest.mark.parametrize("read", [with_bodies, with_uris, over_ros])
def test_the_pictures_of_a_request_share_its_pixels(read: object) -> None:
    assert callable(read)
    assert read(3, pixels=300) == 3
    with pytest.raises(RequestFailed, match="a picture of 10x10; at most 99 pixels are taken"):
        read(3, pixels=299)


@pytest.mark.parametrize("document", ["[" * 60_000, '{"a":' * 12_000])
@pytest.mark.parametrize("read", [of_json, of_picture])
def test_a_deep_document_is_refused_in_a_line(read: Reads, document: str) -> None:
    """Our other servers are sent one in tests/hostile, and MessagePack has its own test."""
    headers = [(native.PARAMETERS_HEADER, document)]
    with pytest.raises(RequestFailed, match="is no JSON: depth limit exceeded") as refused:
        read(headers, document.encode(), Trace(), LIMITS)
    assert str(refused.value).isprintable()
