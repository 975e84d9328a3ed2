"""No code from a peer or a file runs: what would make a folder where it is unpickled, loaded or rendered is refused.

What a file may name, programs and servers, is in `test_nothing_leaves`.
"""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llama_cpp
import msgpack
import numpy as np
import pytest

from s2a_bench.errors import S2AError
from s2a_bench.frames.bag import Recording
from s2a_bench.inference.llama_prompt import ChatTemplate
from s2a_bench.plugins.policy_servers.grpc.pickles import chunk_in
from s2a_bench.plugins.policy_servers.websocket.codec import unpackb
from s2a_bench.plugins.policy_servers.zmq.wire import read


class MakesAFolder:
    """Unpickled, it is the call of `os.mkdir`."""

    def __init__(self, path: Path) -> None:
        self._path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self._path,)


def pickled(path: Path) -> bytes:
    return pickle.dumps(MakesAFolder(path))


def lerobots_answer(path: Path) -> None:
    chunk_in(pickled(path))


def openpis_array(path: Path) -> None:
    array = {b"__ndarray__": True, b"data": pickled(path), b"dtype": "|O", b"shape": (1,)}
    unpackb(msgpack.packb({"actions": array}))


def gr00ts_file(path: Path) -> None:
    file = io.BytesIO()
    np.save(file, np.array([MakesAFolder(path)], object), allow_pickle=True)
    read(msgpack.packb({"__ndarray_class__": True, "as_npy": file.getvalue()}))


def gr00ts_map(path: Path) -> None:
    read(msgpack.packb({b"nd": True, b"type": "|O", b"kind": b"O", b"shape": [1], b"data": pickled(path)}))


def a_bags_yaml(path: Path) -> None:
    folder = path.parent / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text(f"!!python/object/apply:os.mkdir ['{path}']")
    Recording(str(folder), 64, 48)


@pytest.mark.parametrize("reader", [lerobots_answer, openpis_array, gr00ts_file, gr00ts_map, a_bags_yaml])
def test_it_is_refused_and_nothing_ran(reader: Callable[[Path], None], tmp_path: Path) -> None:
    with pytest.raises(S2AError):
        reader(tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_a_models_template_calls_no_function_of_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llama_cpp, "llama_vocab_bos", lambda _: -1)
    monkeypatch.setattr(llama_cpp, "llama_vocab_eos", lambda _: -1)
    monkeypatch.setattr(llama_cpp, "llama_vocab_get_add_bos", lambda _: False)
    source = f"{{{{ cycler.__init__.__globals__.os.mkdir('{tmp_path / 'made'}') }}}}{{{{ messages[0].content }}}}"
    with pytest.raises(ValueError, match="SecurityError"):
        ChatTemplate(source, None)
    assert not (tmp_path / "made").exists()


def test_these_files_would_make_a_folder(tmp_path: Path) -> None:
    """Read by what runs code they do: the tests above can fail."""
    pickle.loads(pickled(tmp_path / "made"))  # noqa: S301 - our own
    assert (tmp_path / "made").exists()
