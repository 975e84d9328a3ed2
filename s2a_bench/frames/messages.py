"""Pictures in ROS 2 messages, recorded or live, as a source delivers them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar, Final, cast

from s2a_bench.errors import SourceError, TransportError
from s2a_bench.frames import NumberedSource, check_size
from s2a_bench.frames.convert import decode_received, resize, to_bgr
from s2a_bench.ros import messages as ros
from s2a_bench.types import Encoding, Frame, Pixels

TYPES: Final = (ros.IMAGE, ros.COMPRESSED_IMAGE)
KEPT: Final = frozenset({"yuv422_yuy2", "bgr8", "rgb8", "mono8"})
"""Raw encodings that are delivered as they are; all else is converted to ``bgr8``."""
COLOURS: Final = frozenset({"bgr8", "rgb8", "bgra8", "rgba8"})


class ImageMessages(NumberedSource):
    """Base of sources of sensor_msgs/Image or CompressedImage, of which the first decides the encoding of all.

    YUYV, which cannot be scaled, is converted to ``bgr8`` for another size.
    """

    option: ClassVar[str] = "source"

    def begin(self, message: Any) -> None:
        """Take the encoding of the first message; raises SourceError if it cannot be read."""
        self.encoding: Encoding = self._frame(message).encoding
        check_size(self.width, self.height, even=self.encoding == "yuv422_yuy2")

    def pixels(self, message: Any) -> Pixels:
        """Return a message's picture as a new array of the source's size; raises SourceError."""
        frame = self._frame(message)
        if frame.encoding != self.encoding:
            raise SourceError(
                f"`{self.option}`: {self.name} changes from {self.encoding} at {self.width}x{self.height} to "
                f"{message.encoding} at {message.width}x{message.height}; a source has one format: cut the recording, "
                "or leave the camera's settings as they are"
            )
        return frame.data.copy() if frame.data.base is not None else frame.data

    def _frame(self, message: Any) -> Frame:
        """Return a message's picture as it is delivered, perhaps a view of the message."""
        with self.errors(f"picture {self._index} cannot be read: "):
            raw = hasattr(message, "encoding")
            frame = ros.frame_of_image(message) if raw else decompressed(message)
            scaled = (frame.width, frame.height) != (self.width, self.height)
            if not raw or frame.encoding not in KEPT or (scaled and frame.encoding == "yuv422_yuy2"):
                frame = replace(frame, encoding="bgr8", data=to_bgr(frame))
            return replace(frame, data=resize(frame.data, self.width, self.height))

    @contextmanager
    def errors(self, what: str = "") -> Iterator[None]:
        """Raise SourceError, naming the source and ``what``, for what is wrong with a message or with its way here."""
        try:
            yield
        except (ValueError, TransportError) as error:
            raise SourceError(f"`{self.option}`: {self.name}: {what}{error}") from error


def decompressed(image: Any) -> Frame:
    """Decode a CompressedImage; ``format`` is plain, as "jpeg", or says what was compressed as what.

    image_transport writes "rgb8; jpeg compressed bgr8". Where bgr8 does not stand at the end, the picture was
    compressed as it was: a mosaic as grey, or with red and blue in each other's place. Raises TransportError.
    """
    encoding, _, coding = image.format.partition(";")
    ros.refuse_depth("16UC1" if "compressedDepth" in coding else encoding)
    try:
        rgb = decode_received(image.data)
    except ValueError as error:
        raise TransportError(f"{len(image.data)} bytes of format '{image.format[: ros.SHOWN]}': {error}") from error
    frame = Frame(-1, ros.nanoseconds(image.header.stamp), rgb.shape[1], rgb.shape[0], "rgb8", rgb)
    if "compressed" in coding and "compressed bgr8" not in coding:
        if encoding in COLOURS:
            return replace(frame, encoding="bgr8")
        if encoding.startswith("bayer_"):
            return replace(frame, encoding=cast("Encoding", encoding), data=rgb[..., 0].copy())
    return frame
