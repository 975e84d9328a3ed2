"""`--record`: frames, requests and tokens of a run of any transport, as ROS 2 topics in MCAP.

Frames go to ``<namespace>/camera/image_raw`` as they were captured, each cell's requests (without their pictures) to
``<namespace>/<cell>/request`` and its tokens to ``<namespace>/<cell>/token``, stamped with ROS time. Nothing is written
while a sample is measured; in stream mode, which has no pauses, a thread writes.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from s2a_bench.clock import realtime_offset_ns
from s2a_bench.options import Options
from s2a_bench.ros import messages as ros
from s2a_bench.ros.record import BagRecorder
from s2a_bench.transport.ros import ROS
from s2a_bench.transport.ros.camera import CAMERA, COMPRESSED_CAMERA, FRAME_ID
from s2a_bench.transport.ros.options import NAMESPACE
from s2a_bench.transport.ros.wire import request_message, token_message
from s2a_bench.types import Frame, Piece, Request


def namespace_of(options: Options) -> str:
    """Return the namespace of the recorded topics: that of ``ros`` among the options of transports."""
    namespace: str = getattr(options, ROS.name).namespace
    return namespace or NAMESPACE


class RunRecorder(BagRecorder):
    def __init__(self, path: Path, namespace: str, *, live: bool) -> None:
        super().__init__(path, live=live)
        self._namespace = namespace
        self._offset_ns = realtime_offset_ns()

    def note(self, name: str, type_name: str, message: Any, at_ns: int) -> None:
        """Record a message on ``<namespace><name>``, stamped with its time on CLOCK_MONOTONIC, also in its header."""
        stamp_ns = at_ns + self._offset_ns
        if hasattr(message, "header"):
            message.header.stamp = ros.stamp(stamp_ns)
        self.write(f"{self._namespace}{re.sub('[^A-Za-z0-9/]', '_', name)}", type_name, message, stamp_ns)

    def frame(self, frame: Frame, of: str = "") -> None:
        """Record a picture of the run's camera, or of the one below ``<namespace><of>``."""
        if frame.encoding in ros.CHANNELS:
            self.note(of + CAMERA, ros.IMAGE, ros.image_message(frame, 0, FRAME_ID), frame.stamp_ns)
        else:
            message = ros.compressed_image_message(frame.data, 0, FRAME_ID, frame.encoding)
            self.note(of + COMPRESSED_CAMERA, ros.COMPRESSED_IMAGE, message, frame.stamp_ns)

    def answer(self, cell: str, request: Request, sent_ns: int, tokens: list[tuple[Piece, int]], error: str) -> None:
        """Record a request and its tokens with the times at which the client received them (CLOCK_MONOTONIC)."""
        self.note(f"/{cell}/request", ros.REQUEST, request_message(request), sent_ns)
        for place, (token, seen_ns) in enumerate(tokens, 1):
            last = place == len(tokens)
            message = token_message(request.id, token, last=last, error=error if last else "")
            self.note(f"/{cell}/token", ros.TOKEN, message, seen_ns)
