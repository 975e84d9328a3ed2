"""Pictures in ROS 2 messages, recorded or live, as a source delivers them."""

from __future__ import annotations

from typing import Any, Final

from s2a_bench.errors import SourceError, TransportError
from s2a_bench.frames import NumberedSource, check_size
from s2a_bench.frames.convert import decode_image, resize, to_bgr
from s2a_bench.frames.encoded import MOST_PIXELS, encoded_size
from s2a_bench.ros import messages as ros
from s2a_bench.types import Encoding, Frame, Pixels

TYPES: Final = (ros.IMAGE, ros.COMPRESSED_IMAGE)
KEPT: Final = frozenset({"yuv422_yuy2", "bgr8", "rgb8", "mono8"})
"""Encodings that are delivered as they are; pictures in all others are converted to ``bgr8``."""


class ImageMessages(NumberedSource):
    """Base of sources of sensor_msgs/Image or CompressedImage, of which the first decides the encoding of all.

    YUYV, which cannot be scaled, is converted to ``bgr8`` for another size, and so are CompressedImage and what is not
    in `KEPT`.
    """

    place: str
    """Where the messages are from, for errors."""

    def begin(self, message: Any) -> None:
        """Take the encoding of the first message; raises SourceError if it cannot be read."""
        self.encoding: Encoding = self._delivered(message)
        if self.encoding == "yuv422_yuy2":
            check_size(self.width, self.height, even=True)

    def pixels(self, message: Any) -> Pixels:
        """Return a message's picture as a new array of the source's size; raises SourceError."""
        if self._delivered(message) != self.encoding:
            raise SourceError(
                f"`source`: {self.name} changes from {self.encoding} at {self.width}x{self.height} to "
                f"{message.encoding} at {message.width}x{message.height}; a source has one format: cut the recording, "
                "or leave the camera's settings as they are"
            )
        try:
            frame = ros.frame_of_image(message) if hasattr(message, "encoding") else _decompressed(message)
            data = resize(frame.data if frame.encoding == self.encoding else to_bgr(frame), self.width, self.height)
        except (ValueError, TransportError) as error:
            raise SourceError(f"`source`: {self.place}: picture {self._index} cannot be read: {error}") from error
        return data.copy() if data.base is not None else data

    def _delivered(self, message: Any) -> Encoding:
        try:
            if not hasattr(message, "encoding"):
                ros.compressed_as(message)
                return "bgr8"
            encoding = ros.encoding_of(message)
        except TransportError as error:
            raise SourceError(f"`source`: {self.place}: {error}") from error
        scaled = (message.width, message.height) != (self.width, self.height)
        return "bgr8" if encoding not in KEPT or (encoding == "yuv422_yuy2" and scaled) else encoding


def _decompressed(message: Any) -> Frame:
    size = encoded_size(memoryview(message.data))
    if size is None:
        raise ValueError(f"{len(message.data)} bytes that are neither a JPEG nor a PNG")
    if size[0] * size[1] > MOST_PIXELS:
        raise ValueError(f"a picture of {size[0]}x{size[1]}; at most {MOST_PIXELS} pixels are decoded")
    rgb = decode_image(message.data)
    return ros.labelled(Frame(-1, 0, rgb.shape[1], rgb.shape[0], "rgb8", rgb), ros.compressed_as(message))
