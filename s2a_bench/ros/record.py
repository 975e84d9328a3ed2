"""Record topics as rosbag2 does, in MCAP, which Foxglove, ``ros2 bag`` and ``mcap`` open.

While something is measured, `BagRecorder.write` only keeps a reference to the CDR that was sent or received anyway; the
file is written by `flush`, which the caller runs between samples. A writer thread would be no alternative there: it
holds the interpreter's lock for a millisecond per VGA image, as long as what is measured. A node or a stream has no
"between"; for them ``live=True`` starts that thread.
"""

from __future__ import annotations

import shutil
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, RLock, Thread
from typing import Any

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from s2a_bench.errors import StoreError
from s2a_bench.ros.messages import serialise, typestore

BAG_VERSION = 8
"""The newest metadata that Humble reads too: 9 writes quality of service in a way that it does not know."""

_UNSET = QosTime(0, 0)
PLAYED_QOS = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    _UNSET,
    _UNSET,
    QosLiveliness.AUTOMATIC,
    _UNSET,
    avoid_ros_namespace_conventions=False,
)
"""The QoS with which ``ros2 bag play`` offers every topic: ROS 2's default profile."""

Cdr = bytes | bytearray | memoryview
BACKLOG_BYTES = 256 * 2**20
"""The unwritten CDR from which on `BagRecorder.write` writes itself instead of filling the memory."""


class BagRecorder(AbstractContextManager["BagRecorder"]):
    """A recording; ``run.mcap`` makes that one file, any other name the folder that ``ros2 bag record`` makes.

    The single file is written in ``run.mcap.recording/`` and moved when it is complete. Without a single message it
    is valid all the same. Raises StoreError for a path that exists or cannot be made, and later when writing fails.
    """

    def __init__(self, path: Path, *, live: bool = False) -> None:
        """Create the file at once, so that a bad path shows before anything is measured."""
        self.path = path
        self._single = path.suffix == ".mcap"
        self._workplace = path.parent / (path.name + ".recording")
        self._folder = self._workplace / path.stem if self._single else path
        for taken in (path, self._folder):
            if taken.exists():
                raise StoreError(f"`record`: {taken} exists already and is not overwritten; move it or name another")
        self._writer = Writer(self._folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        try:
            self._writer.open()
        except (OSError, WriterError) as error:
            raise StoreError(f"`record`: cannot write {path}: {error}") from error
        self._connections: dict[tuple[str, str], Any] = {}
        self._queue: SimpleQueue[tuple[str, str, Any, int]] = SimpleQueue()
        """Topic, type, CDR or a message still to be serialised, stamp."""
        self._more: SimpleQueue[bool] = SimpleQueue()
        self._backlog = 0
        self._counting = Lock()
        self._writing = RLock()
        self._closed = False
        self._failure: StoreError | None = None
        self._thread = Thread(target=self._work, name="recorder", daemon=True) if live else None
        if self._thread is not None:
            self._thread.start()

    def write(self, topic: str, type_name: str, cdr_or_message: Any, stamp_ns: int) -> None:
        """Note one message of ROS type ``pkg/msg/Name`` on the absolute topic ``/x``, from any thread, in microseconds.

        ``cdr_or_message`` is CDR with its header, or a message, serialised when it is written down. It is not copied:
        leave it as it is afterwards. ``stamp_ns`` is ROS time. Raises StoreError once closed, or when writing failed.
        """
        if self._closed:
            raise StoreError(f"`record`: {self.path} is closed")
        if self._failure is not None:
            raise self._failure
        with self._counting:
            self._backlog += _size(cdr_or_message)
            full = self._backlog > BACKLOG_BYTES
        self._queue.put((topic, type_name, cdr_or_message, stamp_ns))
        if self._thread is not None:
            self._more.put(True)
        if full:
            self.flush()

    def flush(self) -> None:
        """Write down what waits; raises StoreError when that fails, and again on every later call."""
        with self._writing:
            with suppress(Empty):
                while self._failure is None:
                    self._write_down(*self._queue.get_nowait())
            if self._failure is not None:
                raise self._failure

    def close(self) -> None:
        """Write the rest and finish the file; may be called twice. Raises StoreError when the recording is damaged."""
        if self._closed:
            return
        self._closed = True
        if self._thread is not None:
            self._more.put(False)
            self._thread.join()
        try:
            self.flush()
            self._writer.close()
            if self._single:
                (self._folder / self.path.name).replace(self.path)
                shutil.rmtree(self._workplace)
        except OSError as error:
            raise self._failed(error) from error
        finally:
            self._writer.abort()  # closes the file where closing did not get that far

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the file however the run ended: what was recorded up to an error is worth keeping, nothing is not."""
        self.close()
        if kind is not None and not self._connections:
            shutil.rmtree(self.path) if self.path.is_dir() else self.path.unlink()

    def _work(self) -> None:
        """Write messages as they arrive, until `close`; `write` raises the errors."""
        while self._more.get():
            with suppress(StoreError):
                self.flush()

    def _write_down(self, topic: str, type_name: str, data: Any, stamp_ns: int) -> None:
        with self._counting:
            self._backlog -= _size(data)
        try:
            if (key := (topic, type_name)) not in self._connections:
                self._connections[key] = self._writer.add_connection(
                    *key, typestore=typestore(), offered_qos_profiles=[PLAYED_QOS]
                )
            cdr = data if isinstance(data, Cdr) else serialise(data, type_name)
            self._writer.write(self._connections[key], stamp_ns, cdr)
        except Exception as error:  # noqa: BLE001 - an unknown type, a foreign message, a full disk: each ends it
            self._failure = self._failed(error)

    def _failed(self, error: Exception) -> StoreError:
        place = self._folder if self._folder.exists() else self.path
        return StoreError(
            f"`record`: writing {self.path} failed: {error or type(error).__name__}; "
            f"what was written is in {place} (`mcap recover` makes a damaged file readable)"
        )


def _size(cdr_or_message: Any) -> int:
    """Return the bytes of CDR; of a message those of its data."""
    if isinstance(cdr_or_message, Cdr):
        return len(cdr_or_message)
    return int(getattr(getattr(cdr_or_message, "data", None), "nbytes", 0))
