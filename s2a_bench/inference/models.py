"""Find and check a model's files: the user's, a known name's, the hub's, or the tiny dummy's, made on first use."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from s2a_bench import extras
from s2a_bench.errors import ModelError, UsageError
from s2a_bench.inference import EngineConfig, Like, Size
from s2a_bench.inference.dummy import dummy_files, write_dummy
from s2a_bench.inference.gguf_file import GgufHeader, read_header
from s2a_bench.text import read_text

CACHE_VARIABLE = "S2A_BENCH_CACHE"
NO_TEMPLATE, RAW_PROMPT = "none", "{% for message in messages %}{{ message['content'] }}{% endfor %}"
"""The value of `EngineConfig.chat_template` for a raw prompt, and the template that makes one."""
TEMPLATE_BYTES = 1 << 20
HUB = "hub:"
HUB_MODELS = {
    "minicpm-v-2.6": "openbmb/MiniCPM-V-2_6-gguf",
    "qwen2.5-vl-3b": "ggml-org/Qwen2.5-VL-3B-Instruct-GGUF",
    "qwen2.5-vl-7b": "ggml-org/Qwen2.5-VL-7B-Instruct-GGUF",
    "qwen3-vl-2b": "Qwen/Qwen3-VL-2B-Instruct-GGUF",
    "qwen3-vl-4b": "Qwen/Qwen3-VL-4B-Instruct-GGUF",
    "smolvlm2-256m": "ggml-org/SmolVLM2-256M-Video-Instruct-GGUF",
    "smolvlm2-500m": "ggml-org/SmolVLM2-500M-Video-Instruct-GGUF",
    "smolvlm2-2.2b": "ggml-org/SmolVLM2-2.2B-Instruct-GGUF",
    "gemma3-4b": "ggml-org/gemma-3-4b-it-GGUF",
    "gemma3-270m": "ggml-org/gemma-3-270m-it-GGUF",
    "internvl3-2b": "ggml-org/InternVL3-2B-Instruct-GGUF",
}
"""Name for `model fetch` and ``--model`` -> its repository on the hub."""


def hub_address(name: str, flag: str) -> tuple[str, str]:
    """Return the repository and the file, "" for the default one, of a known name or ``[hub:]OWNER/REPO[:FILE]``.

    Raises UsageError, which names ``flag``.
    """
    utils = extras.require("huggingface_hub.utils", "model")
    repository, colon, file = HUB_MODELS.get(name, name.removeprefix(HUB)).partition(":")
    try:
        utils.validate_repo_id(repository)
    except utils.HFValidationError:
        repository = ""
    if "/" not in repository or (colon and not file):
        raise UsageError(f"{flag} '{name}' is neither {', '.join(HUB_MODELS)} nor OWNER/REPO[:FILE]")
    return repository, file


def pair(files: Iterable[Path], quants: Iterable[str] = ()) -> tuple[list[Path], Path | None]:
    """Return the language models of the first of ``quants`` that there is, else all of them; and the mmproj."""
    paths = sorted(files)
    mmprojs = [path for path in paths if "mmproj" in path.name.lower()]
    models = _of_quant([path for path in paths if path not in mmprojs], quants)
    return models, next(iter(_of_quant(mmprojs, ("F16", "Q8_0"))), None)


def _of_quant(paths: list[Path], quants: Iterable[str]) -> list[Path]:
    endings = (re.compile(rf"(.*[-._])?{re.escape(quant)}\.gguf", re.IGNORECASE) for quant in quants)
    matches = ([path for path in paths if ending.fullmatch(path.name)] for ending in endings)
    return next(filter(None, matches), paths)


def cached() -> dict[str, list[Path]]:
    """Return the GGUF files in the hub's cache by repository: those of the commit that was fetched last."""
    hub = extras.require("huggingface_hub", "model")
    try:
        repos = hub.scan_cache_dir(extras.require("huggingface_hub.constants", "model").HF_HUB_CACHE).repos
    except (hub.CacheNotFound, ValueError):  # no such folder, or a file
        return {}
    return {
        repo.repo_id: [file.file_path for file in revision.files if file.file_path.suffix == ".gguf"]
        for repo in repos
        if repo.repo_type == "model"
        for revision in sorted(repo.revisions, key=lambda revision: (revision.last_modified, len(revision.files)))
    }


def fetched(name: str) -> tuple[Path, Path | None]:
    """Return the language model and the mmproj, if it has one, of a known name or ``hub:OWNER/REPO[:FILE]``.

    Raises ModelError if it is not fetched yet, or if several quantisations are and none is named.
    """
    repository, file = hub_address(name, "`model`")
    models, mmproj = pair(cached().get(repository, ()))
    models = [path for path in models if not file or path.as_posix().lower().endswith(f"/{file.lower()}")]
    if len(models) == 1:
        return models[0], mmproj
    if not models:
        raise ModelError(f"`model` {name}: not fetched yet; run: s2a-bench model fetch {name.removeprefix(HUB)}")
    names = ", ".join(path.name for path in models)
    raise ModelError(f"`model` {name}: {names} were fetched; choose one, as {HUB}{repository}:{models[0].name}")


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

    def describe(self) -> dict[str, str | bool]:
        """Return a manifest's facts about the files; the first call hashes them, which takes seconds for gigabytes."""
        facts: dict[str, str | bool] = {"dummy": self.dummy, "name": str(self.model.fields.get("general.name", ""))}
        for kind, header in (("model", self.model), ("mmproj", self.mmproj)):
            if header:
                facts |= {kind: str(header.path), f"{kind}_sha256": sha256(header.path)}
        return facts


def cache_folder() -> Path:
    """Return the user's cache folder of s2a-bench, or that of the variable S2A_BENCH_CACHE."""
    if folder := os.environ.get(CACHE_VARIABLE):
        return Path(folder)
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

    A name of `HUB_MODELS` or ``hub:OWNER/REPO[:FILE]`` stands for its fetched files. Raises ModelError if a file is
    missing, damaged or of the wrong kind, or if several mmproj files lie beside the model.
    """
    model_path, mmproj_path = config.model, config.mmproj
    if model_path is None:
        if mmproj_path is not None:
            raise ModelError(f"`mmproj` {mmproj_path}: needs the language model too; give `model`, or leave out both")
        model_path, mmproj_path = tiny_dummy()
    elif (str(model_path) in HUB_MODELS or str(model_path).startswith(HUB)) and not model_path.is_file():
        model_path, fetched_mmproj = fetched(str(model_path))
        mmproj_path = mmproj_path or fetched_mmproj
    model = read_header(model_path, "`model`")
    if model.is_mmproj:
        raise ModelError(f"`model` {model_path}: this is an mmproj (vision tower); give it as `mmproj`")
    mmproj_path = mmproj_path or _mmproj_beside(model_path)
    if not (template := chat_template(config) or str(model.fields.get("tokenizer.chat_template", ""))):
        raise ModelError(
            f"`model` {model_path}: has no chat template; give `chat_template`: a FILE, or none for the raw prompt"
        )
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
    template_name = config.chat_template
    if template_name in {"", NO_TEMPLATE}:
        return RAW_PROMPT if template_name else ""
    try:
        if template := read_text(Path(template_name), TEMPLATE_BYTES):
            return template
        raise ValueError("it is empty")
    except (OSError, ValueError) as error:
        raise ModelError(f"`chat_template` {template_name}: cannot be read ({error})") from error


def _mmproj_beside(model: Path) -> Path | None:
    beside = sorted(model.parent.glob("mmproj*.gguf"))
    if len(beside) > 1:
        names = ", ".join(path.name for path in beside)
        raise ModelError(f"`model` {model}: several mmproj files lie beside it ({names}); choose one with `mmproj`")
    return beside[0] if beside else None


def sha256(path: Path) -> str:
    """Return a file's SHA-256, cached by path, size and time of change, as models are large.

    A cache that cannot be written costs time, nothing else.
    """
    status = path.stat()
    key = hashlib.sha256(f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}".encode()).hexdigest()
    note = cache_folder() / "sha256" / f"{key}.json"
    with suppress(OSError, ValueError, KeyError, TypeError):  # absent or damaged
        return str(json.loads(note.read_text())["sha256"])
    computed = hashlib.sha256()
    with path.open("rb") as content:
        while block := content.read(1 << 22):
            computed.update(block)
    with suppress(OSError):  # without the note it is computed again
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(json.dumps({"path": str(path.resolve()), "sha256": computed.hexdigest()}))
    return computed.hexdigest()
