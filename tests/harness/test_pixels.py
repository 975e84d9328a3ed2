"""The pixels at the engine are held against those of the camera."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.frames import open_source
from s2a_bench.frames.convert import bgr_to_rgb, encode_jpeg, to_bgr, to_rgb
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.pixels import fingerprint
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.serving import engine_handler
from s2a_bench.harness.session import Measured, Place, Session
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.testing.transport import connector, yuyv_frame
from s2a_bench.trace import Trace
from s2a_bench.transport import Handler
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.types import Frame, Request, Token

Measure = Callable[[str, Handler], Measured]


@pytest.fixture
def measure() -> Iterator[Measure]:
    """Make one request over a pipeline to a handler."""
    with ExitStack() as stack:

        def run(name: str, handler: Handler) -> Measured:
            source = open_source("synthetic", 64, 48, fps=30.0, seed=0)
            stack.callback(source.close)
            cell = one_pipeline(name)
            connecting = connector(cell.wiring(timeout_s=20))
            client = next(connecting)(handler)
            stack.callback(connecting.close)  # type: ignore[attr-defined]  # a generator
            config = LatencyConfig(transports=name, max_tokens=3)
            session = Session(cell, client, RequestFeed(source, preencoded=False), resolve(config, print).request)
            return session.measure(Place(0, 0, warmup=False))

        yield run


def handler(*, alter: bool, answer: str = "tokens") -> Handler:
    """An echo engine before which a pixel may be altered."""
    inner = engine_handler(open_engine(EngineConfig(name="echo", answer=answer)))

    def handle(request: Request, trace: Trace) -> Generator[Token, None, None]:
        (image,) = request.images
        data = np.array(image.data)
        data[5, 7, 1] ^= alter
        yield from inner(replace(request, images=(replace(image, data=data),)), trace)

    return handle


@pytest.mark.parametrize(
    "name",
    [
        *("http/best-effort?payload=raw", "http/binary?payload=png", "iceoryx2", "iceoryx2?payload=yuyv", "loopback"),
        *("websocket/openpi", "websocket/openpi-stream?payload=png"),
    ],
)
def test_one_altered_pixel_makes_a_lossless_sample_an_error(measure: Measure, name: str) -> None:
    answer = one_pipeline(name).capabilities.answer_kinds[0]
    good, bad = (measure(name, handler(alter=alter, answer=answer)).sample for alter in (False, True))
    assert (good.error, good.rgb_engine) == ("", good.rgb_source)
    assert good.rgb_source is not None
    assert "other pixels" in bad.error
    assert bad.rgb_source == good.rgb_source != bad.rgb_engine
    assert "rgb_engine" not in good.facts


def test_a_jpeg_may_change_pixels(measure: Measure) -> None:
    sample = measure("http/binary?payload=jpeg", handler(alter=True)).sample
    assert sample.error == ""
    assert None not in {sample.rgb_source, sample.rgb_engine}


def test_a_server_that_tells_nothing_leaves_the_engines_pixels_unknown(measure: Measure) -> None:
    silent = engine_handler(open_engine(EngineConfig(name="echo")), pixels=False)
    sample = measure("loopback", silent).sample
    assert (sample.error, sample.rgb_engine) == ("", None)


def test_a_picture_has_one_checksum_however_it_is_given() -> None:
    frame = yuyv_frame()
    bgr = to_bgr(frame)
    jpeg = encode_jpeg(bgr)
    same = [frame, replace(frame, encoding="bgr8", data=bgr), replace(frame, encoding="rgb8", data=bgr_to_rgb(bgr))]
    assert len({fingerprint(to_rgb(each)) for each in same}) == 1
    assert fingerprint(to_rgb(Frame(0, 0, 64, 48, "jpeg", jpeg))) != fingerprint(to_rgb(frame))
