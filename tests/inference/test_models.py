import multiprocessing
import os
import shutil
from pathlib import Path

import pytest
from gguf import GGUFWriter

from s2a_bench.errors import ModelError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import load_headers, resolve, sha256


def refusal(model: Path | None, mmproj: Path | None = None) -> str:
    with pytest.raises(ModelError) as caught:
        resolve(EngineConfig(model=model, mmproj=mmproj))
    message = str(caught.value)
    assert "\n" not in message
    return message


def paths(config: EngineConfig) -> tuple[Path, Path]:
    assert config.mmproj is not None
    return config.model, config.mmproj


def _race(folder: str, barrier: "multiprocessing.synchronize.Barrier") -> None:
    os.environ["S2A_BENCH_CACHE"] = folder
    barrier.wait(30)
    resolve(EngineConfig())


def test_two_processes_may_make_it_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(2)
    workers = [context.Process(target=_race, args=(str(tmp_path), barrier)) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0]
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    assert load_headers(EngineConfig()).dummy
    assert len(list((tmp_path / "models" / "dummy-tiny").iterdir())) == 2


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "not a GGUF file"),
        (b"hello, I am no model", "not a GGUF file"),
        (b"GGML\x01\x00\x00\x00", "not a GGUF file"),
        (b"GGUF\x03\x00\x00\x00" + bytes(range(256)) * 20, "damaged"),
        (b"GGUF\x63\x00\x00\x00" + bytes(300), "GGUF version 99"),
    ],
)
def test_a_file_of_another_kind_or_with_noise_in_it_is_told(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "model.gguf"
    path.write_bytes(content)
    assert says in refusal(path)


def test_a_file_that_is_missing_or_in_the_others_place_is_named(tiny: EngineConfig, tmp_path: Path) -> None:
    model, mmproj = paths(tiny)
    assert refusal(tmp_path / "no.gguf").startswith(f"`model` {tmp_path}/no.gguf: no such file")
    assert refusal(model, tmp_path / "no.gguf").startswith(f"`mmproj` {tmp_path}/no.gguf: no such file")
    assert "cannot be read" in refusal(tmp_path)
    assert "give it as `mmproj`" in refusal(mmproj, model)
    assert "give it as `model`" in refusal(model, model)
    assert "needs the language model too" in refusal(None, mmproj)


@pytest.mark.parametrize("share", [0.0005, 0.001, 0.5, 0.9999])
def test_a_file_cut_short_is_told_apart_from_a_whole_one(tiny: EngineConfig, tmp_path: Path, share: float) -> None:
    for flag, path in zip(("`model`", "`mmproj`"), paths(tiny), strict=True):
        short = tmp_path / "short.gguf"
        data = path.read_bytes()
        short.write_bytes(data[: int(len(data) * share)])
        message = refusal(short) if flag == "`model`" else refusal(paths(tiny)[0], short)
        assert message.startswith(f"{flag} {short}: ")
        assert "cut short" in message


def test_a_language_model_alone_is_a_text_model(tiny: EngineConfig, tmp_path: Path) -> None:
    model, mmproj = paths(tiny)
    alone = tmp_path / "model.gguf"
    alone.symlink_to(model)
    assert resolve(EngineConfig(model=alone)) == (alone, None)
    assert load_headers(EngineConfig(model=alone)).dummy
    (tmp_path / "mmproj-a.gguf").symlink_to(mmproj)
    assert resolve(EngineConfig(model=alone)) == (alone, tmp_path / "mmproj-a.gguf")
    (tmp_path / "mmproj-b.gguf").symlink_to(mmproj)
    assert "(mmproj-a.gguf, mmproj-b.gguf); choose one" in refusal(alone)


def test_an_mmproj_that_only_hears_is_refused(tiny: EngineConfig, tmp_path: Path) -> None:
    path = tmp_path / "mmproj.gguf"
    writer = GGUFWriter(path, "clip")
    writer.add_bool("clip.has_audio_encoder", val=True)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    assert "no vision tower" in refusal(paths(tiny)[0], path)


def test_the_hash_is_remembered_until_the_file_changes(
    tiny: EngineConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "model.gguf"
    shutil.copy(paths(tiny)[1], path)
    first = sha256(path)
    (note,) = (tmp_path / "cache" / "sha256").iterdir()
    note.write_text(note.read_text().replace(first, "remembered"))
    assert sha256(path) == "remembered"
    note.write_text("damaged")
    assert sha256(path) == first
    with path.open("ab") as file:
        file.write(b"x")
    assert sha256(path) != first
