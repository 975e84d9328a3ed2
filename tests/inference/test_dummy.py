import hashlib
from pathlib import Path

import numpy as np
import pytest

from s2a_bench.inference import dummy
from s2a_bench.inference.dummy import write_dummy
from s2a_bench.inference.dummy.families import FAMILIES, mmproj_tensors, model_tensors
from s2a_bench.inference.dummy.vocab import FULL_UNKNOWN, make_vocab

gguf = pytest.importorskip("gguf")
MINICPM = FAMILIES["minicpm-v-2.6"]


def test_the_numbers_are_those_of_this_revision() -> None:
    # the caches of users hold these; raise REVISION whenever this changes
    assert dummy.REVISION == 3
    shape, digest = MINICPM.shapes["tiny"], hashlib.sha256()
    for tensor in (*model_tensors(MINICPM, shape, 281, "f16"), *mmproj_tensors(MINICPM, shape, shape.width)):
        digest.update(tensor.name.encode())
        for chunk in tensor.parts():
            digest.update(chunk)
    assert digest.hexdigest()[:16] == "95728bf57f26e584"


def test_the_tiny_model_says_only_what_a_server_sends(tmp_path: Path) -> None:
    """A control token, or one byte of a longer character, is no text: its delta is empty or never sent."""
    header = gguf.GGUFReader(write_dummy(tmp_path).model)
    (bias,) = (tensor.data for tensor in header.tensors if tensor.name == "output.bias")
    names = header.fields["tokenizer.ggml.tokens"].contents()
    texts = {name for name, value in zip(names, bias, strict=True) if value == 0}
    assert texts == {*map(chr, range(33, 127)), "\u0120", "\u010a", "\u0120t"}
    assert max(bias[bias != 0]) < -1000


def test_full_size_has_the_parameters_of_minicpm_v_2_6() -> None:
    shape = MINICPM.shapes["full"]
    vocab = make_vocab(full=True)
    model = list(model_tensors(MINICPM, shape, len(vocab.tokens), "q4_0"))
    mmproj = list(mmproj_tensors(MINICPM, shape, shape.width))
    # Qwen2-7B pads its vocabulary to 152064, MiniCPM-V 2.6 does not
    assert sum(int(np.prod(tensor.shape)) for tensor in model) == 7_615_616_512 - (152_064 - 151_666) * 3584 * 2
    # llama.cpp counts as many in the real file: "type f32: 141 tensors, type f16: 198 tensors" (ollama issue 9528)
    assert sum(tensor.kind == "f32" for tensor in model) == 141
    assert len(model) == 141 + 198
    assert sum(tensor.nbytes for tensor in mmproj) / 1e9 == pytest.approx(1.04, abs=0.01)
    assert sum(tensor.nbytes for tensor in model) / 1e9 == pytest.approx(4.43, abs=0.01)


def test_the_full_vocabulary_has_the_sizes_and_places_of_minicpm_v_2_6() -> None:
    vocab = make_vocab(full=True)
    # n_vocab and n_merges as llama.cpp prints them for the real file (ollama issue 9528)
    assert len(vocab.tokens) == len(vocab.types) == len(set(vocab.tokens)) == 151_666
    assert len(vocab.merges) == 151_387
    assert vocab.tokens[151_643:151_648] == ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<image>", "</image>"]
    assert vocab.tokens[151_656:151_658] == ["<slice>", "</slice>"]
    assert vocab.tokens[FULL_UNKNOWN] == "<unk>"


@pytest.mark.parametrize("full", [False, True])
def test_every_merge_joins_two_tokens_into_one_that_exists(full: bool) -> None:
    vocab = make_vocab(full=full)
    known = set(vocab.tokens) | {vocab.merges[FULL_UNKNOWN - 256].replace(" ", "")} if full else set(vocab.tokens)
    for merge in vocab.merges:
        left, right = merge.split(" ")
        assert {left, right, left + right} <= known


def test_a_crash_leaves_no_half_file(tmp_path: Path) -> None:
    def crash(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dummy(tmp_path, progress=crash)
    assert list(tmp_path.iterdir()) == []
