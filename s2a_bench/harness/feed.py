"""How frames come to a request: captured for it (request mode), or taken from a running camera (stream mode)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from random import Random
from threading import Condition, Thread
from typing import TypeAlias

from s2a_bench.clock import Clock, SystemClock
from s2a_bench.errors import S2AError, SourceError
from s2a_bench.frames import FrameSource
from s2a_bench.frames.convert import encode_jpeg, resize, to_bgr
from s2a_bench.trace import RESIDUAL, Mark, Trace
from s2a_bench.transport import CameraSink
from s2a_bench.transport.pictures import JPEG_QUALITY, bgr_of
from s2a_bench.types import Frame


@dataclass(slots=True)
class RequestFeed:
    """Captures ``cameras`` frames for each request, scaled to ``size`` (width, height) if given."""

    source: FrameSource
    _: KW_ONLY
    preencoded: bool
    """Whether the camera is one that delivers JPEG."""
    cameras: int = 1
    size: tuple[int, int] | None = None
    _ready: tuple[Frame, ...] = ()

    def get_ready(self) -> None:
        if self.preencoded:
            self._ready = tuple(
                replace(frame, encoding="jpeg", data=encode_jpeg(to_bgr(frame), JPEG_QUALITY)) for frame in self._read()
            )

    def capture(self, trace: Trace) -> tuple[Frame, ...]:
        trace.mark(RESIDUAL)
        frames = self._ready or self._read()
        trace.mark("capture")
        return tuple(_scaled(frame, *self.size, trace) for frame in frames) if self.size else frames

    def _read(self) -> tuple[Frame, ...]:
        return tuple(self.source.read() for _ in range(self.cameras))


def _scaled(frame: Frame, width: int, height: int, trace: Trace) -> Frame:
    pixels = resize(bgr_of(frame, trace).data, width, height)
    trace.mark("resize")
    return replace(frame, width=width, height=height, encoding="bgr8", data=pixels)


@dataclass(slots=True)
class StreamedFrame:
    """The record of one frame of the running camera, without its pixels."""

    index: int
    captured_ns: int
    intended_ns: int
    marks: list[Mark]
    stamp_ns: int = -1
    """ROS-time stamp if it was published, else -1."""
    used_by: str = ""
    sequence: int = 0
    """Frames published so far, this one included."""
    clock_error_ns: int | None = None
    """Error of the server's marks, if its clock is another host's."""

    @property
    def key(self) -> int:
        """Return the frame's ROS-time stamp, or its tick if it was not published."""
        return self.stamp_ns if self.stamp_ns >= 0 else self.intended_ns


class Camera:
    """Reads a source at its rate on a separate thread and gives every frame to the current sink.

    The ticks are fixed beforehand: a late frame does not delay the next, and its lateness shows.
    """

    def __init__(
        self,
        source: FrameSource,
        fps: float,
        clock: Clock | None = None,
        on_frame: Callable[[Frame], None] | None = None,
    ) -> None:
        """Prepare; `start` starts. ``on_frame`` is called with every frame after it was sent."""
        self._source = source
        self._period_ns = int(1e9 / fps)
        self._clock = clock or SystemClock()
        self._on_frame = on_frame
        self._changed = Condition()
        self._sink: CameraSink | None = None
        self.newest: tuple[StreamedFrame, Frame] | None = None
        self._frames: list[StreamedFrame] = []
        self.published = 0
        self._stopped = False
        self._failure: S2AError | None = None
        self._thread = Thread(target=self._run, name="camera", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped = True
        if self._thread.is_alive():
            self._thread.join()

    def use(self, sink: CameraSink | None) -> None:
        """Give every frame to ``sink``; None: keep the newest, converted to BGR."""
        with self._changed:
            if self._sink is not sink:
                self._sink, self.newest, self._frames = sink, None, []

    def next_frame(self, after: int, timeout_s: float = 10.0) -> int:
        """Wait for a frame with an index above ``after`` and return its index; raises what the source raised."""
        with self._changed:
            self._changed.wait_for(lambda: self._failure or (self.newest and self.newest[0].index > after), timeout_s)
            if self._failure is not None:
                raise self._failure
            if self.newest is None or self.newest[0].index <= after:
                raise SourceError(f"`source`: the camera delivered nothing for {timeout_s:.0f} s")
            return self.newest[0].index

    def drain(self) -> list[StreamedFrame]:
        with self._changed:
            frames, self._frames = self._frames, []
            return frames

    def _run(self) -> None:
        intended_ns = self._clock.now_ns()
        while not self._stopped:
            self._clock.sleep_until_ns(intended_ns)
            try:
                self._step(intended_ns)
            except S2AError as error:
                with self._changed:
                    self._failure = error
                    self._changed.notify_all()
                return
            intended_ns += self._period_ns

    def _step(self, intended_ns: int) -> None:
        sink = self._sink
        trace = Trace()
        trace.mark(RESIDUAL)
        frame = self._source.read()
        trace.mark("capture")
        captured = frame
        record = StreamedFrame(frame.index, frame.stamp_ns, intended_ns, trace.marks)
        if sink is None:
            frame = bgr_of(frame, trace)
        else:
            record.stamp_ns = sink.stamp_ns(frame)
            self.published += 1
            record.sequence = self.published
            with self._changed:  # before it is sent: an answer may name the frame before `publish` returns
                self._frames += [record] if sink is self._sink else []
            sink.publish(frame, trace)
        with self._changed:
            if sink is self._sink:
                self._frames += [record] if sink is None else []
                self.newest = record, frame
                self._changed.notify_all()
        if self._on_frame is not None:
            self._on_frame(captured)


@dataclass(slots=True)
class StreamFeed:
    """Prompts about the camera's newest frame, at a random moment between two frames.

    ``sink`` is for pipelines whose server keeps the newest frame itself.
    """

    camera: Camera
    sink: CameraSink | None
    period_ns: int
    random: Random
    last: StreamedFrame | None = None

    def get_ready(self) -> None:
        """Wait for two new frames, so that the server has one, then for a random part of the period."""
        self.camera.use(self.sink)
        newest = self.camera.newest
        first = self.camera.next_frame(newest[0].index if newest else -1)
        self.camera.next_frame(first)
        clock = SystemClock()
        clock.sleep_until_ns(clock.now_ns() + self.random.randrange(self.period_ns))

    def capture(self, trace: Trace) -> tuple[Frame, ...]:
        """Start the prompt's clock and take the newest frame; none if the server has it."""
        newest = self.camera.newest
        trace.mark(RESIDUAL)
        if newest is None:
            return ()
        self.last = newest[0]
        return () if self.sink else (newest[1],)


Feed: TypeAlias = RequestFeed | StreamFeed
"""`get_ready` does what is not timed; `capture` returns the frames of a prompt and marks the trace."""
