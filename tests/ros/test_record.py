"""A recording holds what was sent, and reads back with rosbags."""

from __future__ import annotations

from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from s2a_bench.errors import StoreError
from s2a_bench.ros import messages as ros
from s2a_bench.ros import record
from s2a_bench.ros.record import BagRecorder
from s2a_bench.transport.ros.wire import token_message
from s2a_bench.types import Frame, Token

STRING = "std_msgs/msg/String"


def cdr(text: str) -> bytearray:
    return ros.serialise(ros.message(STRING, data=text), STRING)


def token(index: int) -> Any:
    return token_message("r", Token(index, f"t{index}", index), last=False)


def read(path: Path) -> list[tuple[str, str, int, bytes]]:
    with Reader(path) as reader:
        return [(c.topic, c.msgtype, stamp, bytes(data)) for c, stamp, data in reader.messages()]


def texts(path: Path) -> list[str]:
    return [ros.deserialise(memoryview(data), STRING).data for *_, data in read(path)]


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_what_was_sent_reads_back_byte_for_byte(tmp_path: Path, name: str, live: bool) -> None:
    ready = ros.serialise(token(1), ros.TOKEN)
    with BagRecorder(tmp_path / name, live=live) as recorder:
        recorder.write("/a", STRING, cdr("one"), 5)
        recorder.write("/b", ros.TOKEN, ready, 6)
        recorder.write("/a", STRING, memoryview(cdr("two")).toreadonly(), 7)
        recorder.write("/b", ros.TOKEN, token(2), 1_700_000_000_000_000_008)
    assert read(tmp_path / name) == [
        ("/a", STRING, 5, bytes(cdr("one"))),
        ("/b", ros.TOKEN, 6, bytes(ready)),
        ("/a", STRING, 7, bytes(cdr("two"))),
        ("/b", ros.TOKEN, 1_700_000_000_000_000_008, bytes(ros.serialise(token(2), ros.TOKEN))),
    ]


def test_definitions_and_hashes_travel_with_it(tmp_path: Path) -> None:
    with BagRecorder(tmp_path / "run.mcap") as recorder:
        recorder.write("/token", ros.TOKEN, token(3), 1)
    with AnyReader([tmp_path / "run.mcap"]) as reader:  # knows no types but the file's, and checks their hashes
        ((connection, _, data),) = list(reader.messages())
        assert reader.deserialize(data, connection.msgtype).text == "t3"
        (qos,) = connection.ext.offered_qos_profiles
        assert (qos.depth, qos.reliability.name, qos.durability.name) == (10, "RELIABLE", "VOLATILE")
    assert ros.type_hash(ros.TOKEN).encode() in (tmp_path / "run.mcap").read_bytes()


def test_writing_waits_for_flush(tmp_path: Path) -> None:
    recorder = BagRecorder(tmp_path / "run")
    size = (tmp_path / "run" / "run.mcap").stat
    before = size().st_size
    image = ros.image_message(Frame(0, 0, 1024, 1024, "rgb8", np.zeros((1024, 1024, 3), np.uint8)), 0, "c")
    recorder.write("/a", ros.IMAGE, ros.serialise(image, ros.IMAGE), 1)
    assert size().st_size == before
    recorder.flush()
    assert size().st_size > before + 3 * 2**20 - 8192
    recorder.close()


def test_a_full_backlog_is_written_by_the_writer_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "BACKLOG_BYTES", 50)
    recorder = BagRecorder(tmp_path / "run.mcap")
    for i in range(9):
        recorder.write("/a", STRING, cdr(f"text {i}"), i)
        assert recorder._backlog <= 50
    recorder.close()
    assert texts(tmp_path / "run.mcap") == [f"text {i}" for i in range(9)]


@pytest.mark.parametrize("live", [False, True])
def test_many_threads_write(tmp_path: Path, live: bool) -> None:
    with BagRecorder(tmp_path / "run.mcap", live=live) as recorder:

        def work(n: int) -> None:
            for i in range(200):
                recorder.write(f"/t{n}", STRING, cdr(f"{n}-{i}"), 1000 * n + i)
                if i % 50 == 0:
                    recorder.flush()

        threads = [Thread(target=work, args=(n,)) for n in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert texts(tmp_path / "run.mcap") == [f"{n}-{i}" for n in range(4) for i in range(200)]


def test_an_empty_recording_is_valid(tmp_path: Path) -> None:
    BagRecorder(tmp_path / "run.mcap").close()
    assert read(tmp_path / "run.mcap") == []


@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_an_empty_recording_of_what_failed_is_removed(tmp_path: Path, name: str) -> None:
    with pytest.raises(StoreError), BagRecorder(tmp_path / name):
        raise StoreError("no server")
    assert not any(tmp_path.iterdir())


def test_what_was_recorded_before_an_error_is_kept(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), BagRecorder(tmp_path / "run.mcap") as recorder:  # noqa: PT012
        recorder.write("/a", STRING, cdr("kept"), 1)
        raise KeyboardInterrupt
    assert texts(tmp_path / "run.mcap") == ["kept"]


def test_nothing_is_overwritten_and_what_is_in_the_way_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(StoreError, match=r"^`record`: .*run\.mcap exists already"):
        BagRecorder(path)
    assert path.read_text() == "precious"
    with pytest.raises(StoreError, match=r"^`record`: \. exists already"):
        BagRecorder(Path())
    with pytest.raises(StoreError, match=r"^`record`: cannot write .*run\.mcap: "):
        BagRecorder(path / "run.mcap")
    recorder = BagRecorder(tmp_path / "killed.mcap")
    with pytest.raises(StoreError, match=r"killed\.mcap\.recording.* exists already"):
        BagRecorder(tmp_path / "killed.mcap")
    recorder.close()


def test_closing_twice_is_fine_and_writing_afterwards_is_not(tmp_path: Path) -> None:
    recorder = BagRecorder(tmp_path / "run.mcap")
    recorder.close()
    recorder.close()
    with pytest.raises(StoreError, match="is closed"):
        recorder.write("/a", STRING, cdr("late"), 1)


@pytest.mark.parametrize("live", [False, True])
def test_a_failure_is_raised_where_messages_come_from(tmp_path: Path, live: bool) -> None:
    recorder = BagRecorder(tmp_path / "run.mcap", live=live)
    recorder.write("/a", STRING, cdr("kept"), 1)
    recorder.write("/a", "no_msgs/msg/Such", b"\0\1\0\0", 2)
    with pytest.raises(StoreError, match=r"^`record`: writing .*run\.mcap failed: .*what was written is in "):
        recorder.flush()
    with pytest.raises(StoreError, match="failed"):
        recorder.write("/a", STRING, cdr("lost"), 3)
    with pytest.raises(StoreError, match="failed"):
        recorder.close()
    assert not (tmp_path / "run.mcap").exists()
    assert (tmp_path / "run.mcap.recording" / "run" / "run.mcap").exists()
