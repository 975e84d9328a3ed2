"""What claims need of a run: the board, the model on its GPU, where tokens come from, mode and payload."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.provenance import UNKNOWN
from s2a_bench.report.claims.claim import Need, Part

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

_MODEL: Final = "MiniCPM-V 2.6"
_MODEL_NAMES: Final = ("minicpmv26", "minicpm26")
"""As files and headers have it, letters and digits only; the paper writes MiniCPM-2.6."""
_LAYERS: Final = 28
"""Of that model: with as many or more asked for, all are on the GPU."""


def told(name: str, field: str, *allowed: str) -> Need:
    """Need a field of the provenance to have one of these values; what nobody told does not."""

    def look(part: Part) -> tuple[bool, str]:
        values = list(dict.fromkeys(getattr(origin, field) for origin in part.origins)) or [UNKNOWN]
        return set(values) <= set(allowed), ", ".join(values)

    return Need(name, " or ".join(allowed), look)


def on_board(board: str) -> Need:
    """Need a run to be measured on a board."""
    return Need("board", board, lambda part: (is_board(part.run, board), machine_of(part.run)))


def either(name: str, first: Need, others: tuple[Need, ...]) -> Need:
    """Need the first, or all others."""

    def look(part: Part) -> tuple[bool, str]:
        met, found = first.look(part)
        rows = [] if met else [need.of(part) for need in others]
        missing = [row for row in rows if not row.met]
        said = (f"{row.need} {row.found}" for row in missing or rows)
        return not missing, found if met else ", ".join(said)

    return Need(name, f"{first.wanted}; or {', '.join(f'{need.name} {need.wanted}' for need in others)}", look)


def _is_model(part: Part) -> tuple[bool, str]:
    facts = _model(part)
    names = {origin.model for origin in part.origins}
    every = [re.sub(r"[^a-z0-9]", "", str(name).lower()) for name in (*names, facts.get("model", ""))]
    return any(known in name for name in every for known in _MODEL_NAMES), ", ".join(sorted(filter(None, names)))


def _on_gpu(part: Part) -> tuple[bool, str]:
    facts = _model(part)
    layers, offload = facts.get("gpu_layers"), facts.get("gpu_offload_supported")
    of_these = all(origin.model_sha256 == facts.get("model_sha256") for origin in part.origins)
    if not isinstance(layers, int) or offload is None or not of_these:
        return False, UNKNOWN
    whole = bool(offload) and (layers < 0 or layers >= _LAYERS)
    where = "all layers on the GPU" if whole else f"{layers} layers on the GPU" if offload and layers else "CPU"
    return whole, where


def _quantised(part: Part) -> tuple[bool, str]:
    found = ", ".join(dict.fromkeys(origin.quantisation for origin in part.origins if origin.quantisation))
    return bool(found), found


def _model(part: Part) -> dict[str, Any]:
    facts: dict[str, Any] = part.run.manifest.get("model") or {}
    return facts


MODEL: Final = Need("model", _MODEL, _is_model)
QUANTISATION: Final = Need("quantisation", "known (the paper does not say which it used)", _quantised)
WEIGHTS: Final = told("weights", "weights", "real")
MEASURED: Final = told("tokens", "tokens", "measured")
GPU: Final = Need("processor", "all layers on the GPU", _on_gpu)
PAPERS_MODEL: Final = (MODEL, WEIGHTS, GPU, MEASURED)
"""What a claim about a model needs; an unknown provenance meets none of it."""


def is_board(run: Run, name: str) -> bool:
    """Return whether a run was measured on the board of that name."""
    facts = run.manifest.get("environment", {})
    names = [str(facts.get("board", "")), *(str(gpu.get("name", "")) for gpu in facts.get("gpus", []))]
    wanted = name.lower().removeprefix("jetson ").split()
    # The next word would make it another one: RTX 4080 SUPER is no RTX 4080.
    return any(
        words[place : place + len(wanted)] == wanted
        and (words[place + len(wanted) :] or [""])[0] not in {"super", "laptop"}
        for words in (each.lower().split() for each in names)
        for place in range(len(words))
    )


def machine_of(run: Run) -> str:
    """Name the machine of a run by what makes it comparable."""
    facts: dict[str, Any] = run.manifest.get("environment", {})
    gpus = " + ".join(str(gpu.get("name")) for gpu in facts.get("gpus", []))
    names = [str(facts[name]) for name in ("board", "cpu") if facts.get(name)] + ([gpus] if gpus else [])
    return ", ".join(names) or "a machine that is not known"
