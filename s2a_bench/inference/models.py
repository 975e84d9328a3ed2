"""Find and check the two files of a model: the user's, a known name's, or the tiny dummy, made on first use."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from s2a_bench import extras
from s2a_bench.errors import ModelError
from s2a_bench.inference import EngineConfig, Like, Size
from s2a_bench.inference.dummy import dummy_files, write_dummy
from s2a_bench.inference.gguf_file import GgufHeader, read_header
from s2a_bench.text import read_text

CACHE_VARIABLE = "S2A_BENCH_CACHE"
NO_TEMPLATE, RAW_PROMPT = "none", "{% for message in messages %}{{ message['content'] }}{% endfor %}"
"""The value of `EngineConfig.chat_template` for a raw prompt, and the template that makes one."""
TEMPLATE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class HubModel:
    repository: str
    model: str
    """File name of the language model with ``{quant}`` in it."""
    mmproj: str
    quant: str
    """The default quantisation."""

    def model_file(self, quant: str) -> str:
        return self.model.format(quant=quant)


HUB_MODELS: dict[str, HubModel] = {
    "minicpm-v-2.6": HubModel(
        "openbmb/MiniCPM-V-2_6-gguf", "ggml-model-{quant}.gguf", "mmproj-model-f16.gguf", "Q4_K_M"
    ),
}
"""Name for `model fetch` and ``--model`` -> its files."""


def fetched(name: str) -> tuple[Path, Path]:
    """Return the paths of a known model's fetched language model and mmproj, in the hub's cache.

    Raises ModelError if it is not fetched yet, or if several quantisations are.
    """
    hub = extras.require("huggingface_hub", "model")
    known = HUB_MODELS[name]
    mmproj = hub.try_to_load_from_cache(known.repository, known.mmproj)
    folder = Path(mmproj).parent if isinstance(mmproj, str) else None
    models = [path for path in sorted(folder.glob(known.model_file("*"))) if path.is_file()] if folder else []
    if not models or not isinstance(mmproj, str):
        raise ModelError(f"`model` {name}: not fetched yet; run: s2a-bench model fetch {name}")
    if len(models) > 1:
        before, after = known.model_file("*").split("*")
        quants = ", ".join(path.name.removeprefix(before).removesuffix(after) for path in models)
        raise ModelError(f"`model` {name}: several were fetched ({quants}); give a path, as {models[0]}")
    return models[0], Path(mmproj)


@dataclass(frozen=True, slots=True)
class ModelFiles:
    model: GgufHeader
    mmproj: GgufHeader | None
    """None for a text model, which sees no pictures."""
    chat_template: str
    """A Jinja text."""

    @property
    def dummy(self) -> bool:
        return any(header.is_dummy for header in (self.model, self.mmproj) if header)


def cache_folder() -> Path:
    """Return the user's cache folder of s2a-bench, or that of the variable S2A_BENCH_CACHE."""
    if chosen := os.environ.get(CACHE_VARIABLE):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "s2a-bench"


def dummy_folder(size: Size, like: Like = "minicpm-v-2.6") -> Path:
    """Return the folder of one dummy in the cache: a folder has one mmproj, so that it is found."""
    return cache_folder() / "models" / (f"dummy-{size}" if like == "minicpm-v-2.6" else f"dummy-{like}-{size}")


def tiny_dummy() -> tuple[Path, Path]:
    """Return the tiny dummy's two files, written first if they are not in the cache; several processes may do so."""
    folder = dummy_folder("tiny")
    files = dummy_files(folder, "tiny", "f16")
    if not all(file.is_file() for file in files):
        write_dummy(folder, "tiny", "f16")
    return files


def resolve(config: EngineConfig) -> tuple[Path, Path | None]:
    """Return the paths of language model and mmproj for ``config``; raises ModelError, see `load_headers`."""
    files = load_headers(config)
    return files.model.path, files.mmproj.path if files.mmproj else None


def load_headers(config: EngineConfig) -> ModelFiles:
    """Read and check both headers; a model without an mmproj, named or beside it, is a text model.

    A name of `HUB_MODELS` instead of a path stands for its fetched files. Raises ModelError if a file is missing,
    damaged or of the wrong kind, or if several mmproj files lie beside the model.
    """
    model_path, mmproj_path = config.model, config.mmproj
    if model_path is None:
        if mmproj_path is not None:
            raise ModelError(f"`mmproj` {mmproj_path}: needs the language model too; give `model`, or leave out both")
        model_path, mmproj_path = tiny_dummy()
    elif str(model_path) in HUB_MODELS and not model_path.is_file():
        model_path, fetched_mmproj = fetched(str(model_path))
        mmproj_path = mmproj_path or fetched_mmproj
    model = read_header(model_path, "`model`")
    if model.is_mmproj:
        raise ModelError(f"`model` {model_path}: this is an mmproj (vision tower); give it as `mmproj`")
    if not (template := chat_template(config) or str(model.fields.get("tokenizer.chat_template", ""))):
        raise ModelError(f"`model` {model_path}: has no chat template; give `chat_template` FILE, or none: no template")
    mmproj_path = mmproj_path or _mmproj_beside(model_path)
    if mmproj_path is None:
        return ModelFiles(model, None, template)
    mmproj = read_header(mmproj_path, "`mmproj`")
    if not mmproj.is_mmproj:
        raise ModelError(
            f"`mmproj` {mmproj.path}: this is a language model ({mmproj.architecture or 'no architecture'}), "
            "not an mmproj; give it as `model`"
        )
    if mmproj.fields.get("clip.has_vision_encoder") is not True:
        raise ModelError(f"`mmproj` {mmproj.path}: has no vision tower; give the mmproj of a model that takes pictures")
    return ModelFiles(model, mmproj, template)


def chat_template(config: EngineConfig) -> str:
    """Return the chosen chat template, a Jinja text; empty: the model's own; raises ModelError."""
    chosen = config.chat_template
    try:
        return RAW_PROMPT if chosen == NO_TEMPLATE else read_text(Path(chosen), TEMPLATE_BYTES) if chosen else ""
    except (OSError, ValueError) as error:
        raise ModelError(f"`chat_template` {chosen}: cannot be read ({error})") from error


def _mmproj_beside(model: Path) -> Path | None:
    found = sorted(model.parent.glob("mmproj*.gguf"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ModelError(f"`model` {model}: several mmproj files lie beside it ({names}); choose one with `mmproj`")
    return found[0] if found else None


def sha256(path: Path) -> str:
    """Return a file's SHA-256, cached by path, size and time of change, as models are large."""
    try:
        return str(json.loads(_note(path).read_text())["sha256"])
    except (OSError, ValueError, KeyError, TypeError):  # absent or damaged
        value = digest(path)
        remember_sha256(path, value)
        return value


def digest(path: Path) -> str:
    computed = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 22):
            computed.update(block)
    return computed.hexdigest()


def remember_sha256(path: Path, value: str) -> None:
    """Cache a file's SHA-256 in one step; a cache that cannot be written costs time, nothing else."""
    note = _note(path)
    with suppress(OSError):
        note.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=note.parent, delete=False) as file:
            json.dump({"path": str(path.resolve()), "sha256": value}, file)
        Path(file.name).replace(note)


def _note(path: Path) -> Path:
    status = path.stat()
    key = hashlib.sha256(f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}".encode()).hexdigest()
    return cache_folder() / "sha256" / f"{key}.json"
