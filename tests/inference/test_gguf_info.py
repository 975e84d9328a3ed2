import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from gguf import GGMLQuantizationType, GGUFReader, GGUFWriter
from typer.testing import CliRunner

from s2a_bench.cli.model import app
from s2a_bench.errors import ModelError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.dummy import SHAPES, SPECIAL, write_dummy
from s2a_bench.inference.gguf_file import SpecialToken, describe, read_array, read_header
from s2a_bench.inference.models import sha256

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/s2a-bench-model-1.json").read_text())
FLAG = "model info"


def paths(tiny: EngineConfig) -> tuple[Path, Path]:
    assert tiny.model
    assert tiny.mmproj
    return tiny.model, tiny.mmproj


def written(path: Path, fill: Callable[[GGUFWriter], None], architecture: str = "qwen2") -> Path:
    writer = GGUFWriter(path, architecture)
    fill(writer)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return path


def test_a_language_model_is_described(tiny: EngineConfig) -> None:
    info = describe(paths(tiny)[0], FLAG)
    assert (info.architecture, info.mmproj, info.dummy, info.file_type) == ("qwen2", False, True, "F16")
    assert info.settings["context_length"] == 32768
    assert info.settings["block_count"] == SHAPES["tiny"].layers
    assert info.settings["attention.layer_norm_rms_epsilon"] == 1e-6
    assert info.tokenizer == {"model": "gpt2", "pre": "qwen2"}
    assert info.vocabulary
    assert (info.vocabulary.tokens, info.vocabulary.merges) == (281, 1)
    assert info.vocabulary.special["eos"] == SpecialToken(259, "<|im_end|>")
    assert info.vocabulary.control == [*SPECIAL, "<unk>"]
    assert info.chat_template
    assert info.chat_template.startswith("{% for message in messages %}")


def test_an_mmproj_is_described_without_what_it_has_not(tiny: EngineConfig) -> None:
    info = describe(paths(tiny)[1], FLAG)
    assert (info.architecture, info.mmproj) == ("clip", True)
    assert info.settings["projector_type"] == "resampler"
    assert info.settings["minicpmv_query_num"] == 64
    assert info.settings["vision.block_count"] == SHAPES["tiny"].vision_layers
    assert info.vocabulary is None
    assert info.chat_template is None


@pytest.mark.parametrize("quant", ["f16", "q8_0", "q4_0"])
def test_counts_and_bytes_are_those_that_gguf_py_reads(tmp_path: Path, quant: Any) -> None:
    for path in write_dummy(tmp_path, "tiny", quant):
        info, reader = describe(path, FLAG), GGUFReader(path)
        assert info.parameters == sum(int(tensor.n_elements) for tensor in reader.tensors)
        assert sum(share.parameters for share in info.types) == info.parameters
        for share in info.types:
            own = [tensor for tensor in reader.tensors if tensor.tensor_type.name == share.kind]
            assert (share.tensors, share.bytes) == (len(own), sum(int(tensor.n_bytes) for tensor in own))
        assert sum(group.tensors for group in info.groups) == len(reader.tensors)
        assert sum(group.bytes for group in info.groups) == sum(share.bytes for share in info.types)
        header = read_header(path, FLAG)
        for key, place in header.arrays.items():
            ours, theirs = read_array(header, key, FLAG), reader.fields[key].contents()
            assert len(ours) == place.length
            assert ours == theirs


def test_layers_of_one_shape_are_one_line_and_keep_their_types_apart(tmp_path: Path) -> None:
    def fill(writer: GGUFWriter) -> None:
        for layer in range(3):
            writer.add_tensor(f"blk.{layer}.ffn_down.weight", np.zeros((4, 32), np.float32 if layer else np.float16))
        writer.add_tensor("blk.3.ffn_down.weight", np.zeros((8, 32), np.float32))
        writer.add_tensor("output.weight", np.zeros((2, 34), np.uint8), raw_dtype=GGMLQuantizationType.Q8_0)

    info = describe(written(tmp_path / "m.gguf", fill), FLAG)
    found = [(group.name, group.shape, group.kinds, group.tensors, group.bytes) for group in info.groups]
    assert found == [
        ("blk.N.ffn_down.weight", [4, 32], ["F32", "F16"], 3, 2 * 512 + 256),
        ("blk.N.ffn_down.weight", [8, 32], ["F32"], 1, 1024),
        ("output.weight", [2, 32], ["Q8_0"], 1, 68),
    ]
    assert info.parameters == 3 * 128 + 256 + 64


def test_licence_and_name_are_shown_and_what_is_missing_is_absent(tmp_path: Path) -> None:
    def fill(writer: GGUFWriter) -> None:
        writer.add_license("apache-2.0")
        writer.add_name("a [bold]name[/bold]")
        writer.add_file_type(15)
        writer.add_float32("qwen2.odd", float("nan"))
        writer.add_eos_token_id(7)
        writer.add_description("\x1b[31mred\x07")
        writer.add_token_list(["a", "b"])

    path = written(tmp_path / "m.gguf", fill)
    found = json.loads(CliRunner().invoke(app, ["info", str(path), "--json"]).stdout)
    jsonschema.validate(found, SCHEMA)
    (facts,) = found["files"]
    assert facts["general"] == {
        "license": "apache-2.0",
        "name": "a [bold]name[/bold]",
        "description": "\x1b[31mred\x07",
    }
    assert facts["file_type"] == "Q4_K_M"
    assert facts["settings"] == {"odd": "nan"}
    assert facts["vocabulary"] == {"tokens": 2, "merges": 0, "special": {}, "control": []}  # 7 is no token of two
    assert not {"chat_template", "sha256"} & set(facts)
    text = CliRunner().invoke(app, ["info", str(path)]).stdout
    assert "license: apache-2.0" in text
    assert "name: a [bold]name[/bold]" in text
    assert "description: \N{REPLACEMENT CHARACTER}[31mred" in text


def test_json_is_one_object_of_the_schema_and_the_hash_is_computed_on_request(
    tiny: EngineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    for path in paths(tiny):
        for flags, hashed in (([], False), (["--hash"], True), ([], True)):  # known from then on
            result = CliRunner().invoke(app, ["info", str(path), "--json", *flags])
            assert result.exit_code == 0, result.output
            found = json.loads(result.stdout)
            jsonschema.validate(found, SCHEMA)
            assert found["files"][0].get("sha256") == (sha256(path) if hashed else None)


def test_people_read_text_and_tables(tiny: EngineConfig) -> None:
    text = CliRunner().invoke(app, ["info", str(paths(tiny)[0])]).stdout
    assert text.startswith(f"{paths(tiny)[0]}\nlanguage model, architecture qwen2, DUMMY WEIGHTS\n")
    for part in (
        "blk.N.ffn_down.weight",
        "256 x 768",
        "context_length 32768",
        "eos 259 '<|im_end|>'",
        "chat template:",
    ):
        assert part in text


def test_a_name_that_is_not_fetched_and_a_path_that_is_not_there_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    for what, message in (
        ("minicpm-v-2.6", "model info minicpm-v-2.6: not fetched yet"),
        ("no.gguf", "model info no.gguf: no such file"),
        (str(tmp_path), f"model info {tmp_path}: cannot be read"),
    ):
        error = CliRunner().invoke(app, ["info", what]).exception
        assert isinstance(error, ModelError)
        assert message in str(error)
        assert "\n" not in str(error)


def test_no_alignment_is_a_damaged_header(tmp_path: Path) -> None:
    path = written(tmp_path / "m.gguf", lambda writer: writer.add_uint32("general.alignment", 64))
    data = path.read_bytes()
    at = data.index(b"general.alignment") + len(b"general.alignment") + 4
    assert data[at : at + 4] == struct.pack("<I", 64)
    path.write_bytes(data[:at] + bytes(4) + data[at + 4 :])
    with pytest.raises(ModelError, match="damaged"):
        read_header(path, FLAG)


def error_of(path: Path) -> str:
    error = CliRunner().invoke(app, ["info", str(path)]).exception
    assert isinstance(error, ModelError)
    (line,) = str(error).splitlines()
    return line


def test_a_token_that_is_no_text_is_one_line(tmp_path: Path) -> None:
    path = written(tmp_path / "m.gguf", lambda writer: writer.add_token_list(["a", "bcdefgh"]))
    path.write_bytes(path.read_bytes().replace(b"bcdefgh", b"bcd\xff\xfegh"))
    assert error_of(path) == f"model info {path}: the GGUF header is damaged or cut short; fetch the file again"


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
