"""Models that can be fetched by name, and where their files lie once fetched; nothing here talks to the network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from s2a_bench import extras
from s2a_bench.errors import ModelError


@dataclass(frozen=True, slots=True)
class HubModel:
    """Where a model's two files lie on the hub."""

    repository: str
    model: str
    """File name of the language model with ``{quant}`` in it."""
    mmproj: str
    quant: str
    """Quantisation that is fetched unless the user names one."""

    def model_file(self, quant: str) -> str:
        """Name the language model's file of one quantisation."""
        return self.model.format(quant=quant)

    def quants(self, files: list[str]) -> list[str]:
        """Return the quantisations that a list of file names holds, sorted."""
        before, after = self.model.split("{quant}")
        names = [file for file in files if file.startswith(before) and file.endswith(after)]
        return sorted(file[len(before) : len(file) - len(after)] for file in names)


HUB_MODELS: dict[str, HubModel] = {
    "minicpm-v-2.6": HubModel(
        "openbmb/MiniCPM-V-2_6-gguf", "ggml-model-{quant}.gguf", "mmproj-model-f16.gguf", "Q4_K_M"
    ),
}
"""Name for `model fetch`, `model info` and ``--model`` -> its files."""


def fetched(name: str, flag: str) -> tuple[Path, Path]:
    """Return the paths of a known model's fetched language model and mmproj, in the hub's own cache.

    Raises ModelError where it is not fetched yet, or where several quantisations are there.
    """
    hub = extras.require("huggingface_hub", "model")
    known = HUB_MODELS[name]
    mmproj = hub.try_to_load_from_cache(known.repository, known.mmproj)
    folder = Path(mmproj).parent if isinstance(mmproj, str) else None
    models = [path for path in sorted(folder.glob(known.model_file("*"))) if path.is_file()] if folder else []
    if not models or not isinstance(mmproj, str):
        raise ModelError(f"{flag} {name}: not fetched yet; run: s2a-bench model fetch {name}")
    if len(models) > 1:
        quants = ", ".join(known.quants([path.name for path in models]))
        raise ModelError(f"{flag} {name}: several were fetched ({quants}); give a path, as {models[0]}")
    return models[0], Path(mmproj)
