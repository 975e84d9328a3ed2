import os
import struct
from pathlib import Path

import pytest
from gguf import GGUFWriter

from s2a_bench.errors import ModelError
from s2a_bench.inference.gguf_file import read_header

FLAG = "`model`"


def error_of(path: Path) -> str:
    with pytest.raises(ModelError) as failure:
        read_header(path, FLAG)
    (line,) = str(failure.value).splitlines()
    return line


def test_no_alignment_is_a_damaged_header(tmp_path: Path) -> None:
    path = tmp_path / "m.gguf"
    writer = GGUFWriter(path, "qwen2")
    writer.add_uint32("general.alignment", 64)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    data = path.read_bytes()
    at = data.index(b"general.alignment") + len(b"general.alignment") + 4
    assert data[at : at + 4] == struct.pack("<I", 64)
    path.write_bytes(data[:at] + bytes(4) + data[at + 4 :])
    assert error_of(path).endswith("the GGUF header is damaged or cut short; fetch the file again")


@pytest.mark.parametrize("at", [8, 16])
def test_a_count_without_sense_is_told_at_once(tmp_path: Path, at: int) -> None:
    path = tmp_path / "m.gguf"
    path.write_bytes(b"GGUF" + struct.pack("<IQQ", 3, 0, 0) + bytes(50_000_000))
    with path.open("r+b") as file:
        file.seek(at)
        file.write(struct.pack("<Q", 2**40))
    assert "the GGUF header is damaged" in error_of(path)


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    assert "not a GGUF file" in error_of(tmp_path / "fifo")
    (tmp_path / "empty").touch()
    assert "it is empty" in error_of(tmp_path / "empty")
