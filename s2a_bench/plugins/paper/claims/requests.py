"""Measures of latency and throughput runs: facts of machine and model, stages of requests, tokens a second."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from math import inf
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.requests import RequestCell, cells_of
from s2a_bench.experiments.throughput.metrics import throughput_cells
from s2a_bench.plugins.paper import Published
from s2a_bench.plugins.paper.claims import Need, RunPart
from s2a_bench.policy import Floats
from s2a_bench.provenance import NONE, UNKNOWN, Provenance
from s2a_bench.stats import Ratio, summarise, summary_of
from s2a_bench.stats.batches import Blocks, Rows
from s2a_bench.stats.change import FEWEST_LAUNCHES, Change, change_between, ratio_of_launches
from s2a_bench.store.run import StoredRun
from s2a_bench.transport import EXTERNAL, PROGRAM, declared_transport
from s2a_bench.writers.tables import interval, mean_sd

_MODEL: Final = "MiniCPM-V 2.6"
_MODEL_NAMES: Final = re.compile("minicpmv?26")
"""Its name in files and headers, letters and digits only; the paper writes MiniCPM-2.6."""
_LAYERS: Final = 28
"""Layers of that model: with `--gpu-layers` this or more, all are on the GPU."""
NEAR: Final = 0.10
"""Means within this share of the paper's are equal: the paper gives no spread between machines."""
_METRIC: Final = "e2e_without_inference"
_HTTP, _BINARY, _LLAMA_SERVER, _ROS = "http/as-deployed", "http/binary", "http/llama-server", "ros"
_NAMES: Final = ("engine", "model", "quantisation")
"""Fields that differ between llama-server and the engine `llama` on the same file."""
_SMALL: Final = 50_000
FEWEST_BITS, MOST_BITS = 4, 16
"""Bits a weight between which the paper's quantisation is taken to lie."""
_BITS: Final = re.compile(r"[QF](\d+)")


def one_of(name: str, *values: str) -> Need:
    """Return the need that a fact is one of these texts."""
    return Need(name, " or ".join(values), lambda fact: fact in values)


def on_board(board: str) -> Need:
    """Return the need for a board of that name; with "super" or "laptop" after it, it is another one."""
    name = re.escape(board.removeprefix("Jetson "))
    pattern = re.compile(rf"(?<!\S){name}(?![^\s,])(?! (?:super|laptop)\b)", re.IGNORECASE)
    return Need("board", board, lambda fact: bool(pattern.search(fact)))


PAPERS_MODEL: Final = (
    one_of("model", _MODEL),
    one_of("weights", "real"),
    one_of("processor", "all layers on the GPU"),
    one_of("tokens", "measured"),
    one_of("pictures", "seen"),
)
"""The needs of a claim about a model; an unknown provenance meets none."""


def facts_of(run: StoredRun, origins: Sequence[Provenance]) -> dict[str, Any]:
    """Return the facts of machine, model and provenance; an absent one is unknown."""
    facts, model = run.manifest.get("environment", {}), run.manifest.get("model") or {}
    gpus = " + ".join(str(gpu.get("name")) for gpu in facts.get("gpus", []))
    known = {
        name: ", ".join(filter(None, dict.fromkeys(getattr(origin, name) for origin in origins))) or UNKNOWN
        for name in ("model", "weights", "tokens", "quantisation", "link")
    }
    names = re.sub(r"[^a-z0-9]", "", f"{known['model']} {model.get('model')}".lower())
    return known | {
        "pictures": next(filter(None, (origin.pictures for origin in origins)), "seen"),
        "board": ", ".join(filter(None, (facts.get("board"), facts.get("cpu"), gpus))) or "a machine that is not known",
        "model": _MODEL if _MODEL_NAMES.search(names) else known["model"],
        "processor": _processor(model, {origin.model_sha256 for origin in origins}),
        "source": _source(run, origins),
    }


def _processor(model: Mapping[str, Any], answered: set[str]) -> str:
    """Return the processor of the model's layers; unknown if another model answered."""
    layers, offload = model.get("gpu_layers"), model.get("gpu_offload_supported")
    if not isinstance(layers, int) or offload is None or answered - {model.get("model_sha256")}:
        return UNKNOWN
    return f"{'all' if layers < 0 or layers >= _LAYERS else layers} layers on the GPU" if offload and layers else "CPU"


def _source(run: StoredRun, origins: Sequence[Provenance]) -> str:
    """Return the emulated board of the paper with its rate, else the origin of the tokens."""
    profiles = {origin.profile if origin.emulated else "" for origin in origins}
    for board in run.manifest.get("boards", []):
        if board.get("origin") == "paper" and {board["name"]} == profiles:
            return emulated(board["name"], board["tokens_per_s"])
    return "; ".join(dict.fromkeys(origin.line for origin in origins)) or UNKNOWN


def emulated(profile: str, rate: float) -> str:
    return f"EMULATED after {profile}, {rate:g} tokens/s of table II"


def exact(value: float) -> Ratio:
    """Return a computed value, without spread."""
    return Ratio(value, value, value)


def change(over: Floats, base: Floats, seed: int, *, paired: bool = False, exact: bool = False) -> Change:
    """Compare the means of two sides in order of time; ``paired`` if rows i of both belong together."""
    return change_between([Rows(base)], [Rows(over)], "mean", seed=seed, paired=paired, exact=exact)


def pairs(run: StoredRun) -> Iterator[RunPart]:
    """Yield every pair of a cell of HTTP as usually deployed, or llama-server, and a cell of ROS."""
    cells = cells_of(run)
    https = [cell for cell in cells if "/".join(cell.path) in {_HTTP, _LLAMA_SERVER}]
    for pair in product(https, [cell for cell in cells if cell.pipeline == _ROS]):
        facts = {
            "both sides": ", ".join([*_unlike(pair), *_asked(run, pair)]) or "alike",
            "servers": _others(run, pair) or "started by the run",
            "launches": sum(map(bool, _blocks(pair)[0].values())),
            "stages": "".join(f"hidden by {cell.name}" for cell in pair if cell.has_ingest) or "seen",
        }
        summaries = [(cell.name, summary_of(cell.values(_metric(pair)))) for cell in pair]
        times = ", ".join(f"{name} {mean_sd(each)} ms" for name, each in summaries if each)
        yield _pair(run, pair, facts, f"{times} (mean ± sd, n = {pair[0].n}).")


def bodies(run: StoredRun) -> Iterator[RunPart]:
    """Yield pairs of HTTP with Base64 and without, of the same payload and size."""
    cells = [cell for cell in cells_of(run) if cell.values("payload_bytes").size]
    coded, plain = ([cell for cell in cells if "/".join(cell.path) == path] for path in (_HTTP, _BINARY))
    for pair in product(coded, plain):
        if all(pair[0].about[name] == pair[1].about[name] for name in ("payload", "size")):
            texts = ", ".join(f"{cell.name} {_bytes(cell):,.0f} bytes" for cell in pair)
            yield _pair(run, pair, {"bytes a picture": round(_bytes(pair[1]))}, f"{texts}.")


def _pair(run: StoredRun, pair: tuple[RequestCell, RequestCell], facts: dict[str, Any], about: str) -> RunPart:
    both = {name: " and ".join(dict.fromkeys(cell.about[name] for cell in pair)) for name in ("mode", "payload")}
    origins = [cell.origin for cell in pair]
    return RunPart(run, facts_of(run, origins) | both | facts, origins, _launches(*pair), pair, about)


def _launches(*cells: RequestCell) -> int:
    return min(len(np.unique(cell.column("launch"))) for cell in cells)


def _unlike(pair: tuple[RequestCell, RequestCell]) -> list[str]:
    """Return the differences of frames and engines; llama-server and llama on the same file are equal."""
    http, ros = (cell.origin.to_dict() | {"size": cell.about["size"]} for cell in pair)
    engines = http["engine"], ros["engine"]
    same_file = engines == ("llama-server", "llama") and http["model_sha256"] == ros["model_sha256"] != ""
    both = {name: dict.fromkeys((http[name] or NONE, value or NONE)) for name, value in ros.items()}
    return [
        f"{name} {' and '.join(values)}"
        for name, values in both.items()
        if (len(values) > 1 or UNKNOWN in values) and not (same_file and name in _NAMES)
    ]


def _asked(run: StoredRun, pair: tuple[RequestCell, RequestCell]) -> list[str]:
    """Return the options that are not the defaults; payload and external servers have needs of their own."""
    pipelines = run.manifest.get("configuration", {}).get("pipelines", {})
    return [
        f"{cell.name} with {name} {value}"
        for cell in pair
        for name, value in pipelines.get(cell.name, {}).items()
        if name not in {"payload", *_external(cell)}
    ]


def _others(run: StoredRun, pair: tuple[RequestCell, RequestCell]) -> str:
    pipelines = run.manifest.get("configuration", {}).get("pipelines", {})
    external = [f"{cell.name} {UNKNOWN}" for cell in pair if cell.name not in pipelines]
    for cell in pair:
        named = {name for name in _external(cell) if pipelines.get(cell.name, {}).get(name)}
        external += [f"{cell.name} by {name}" for name in sorted(named - {"llama_server"})]
    return ", ".join(external)


def _external(cell: RequestCell) -> list[str]:
    return [*declared_transport(cell.pipeline).options.of_sides(EXTERNAL, PROGRAM)]


REQUESTS: Final = one_of("mode", "request")
COMPARED: Final = (
    REQUESTS,
    one_of("payload", "jpeg-preencoded and raw", "jpeg-preencoded and yuyv"),
    one_of("link", "real"),
    Need(
        "both sides",
        "alike: engine, model, size, default options; llama-server and llama are, on the same file",
        "alike".__eq__,
    ),
    one_of("servers", "started by the run"),
    Need("launches", f"{FEWEST_LAUNCHES} or more", lambda fact: fact >= FEWEST_LAUNCHES),
)
"""The needs of a pair of HTTP/JSON and ROS."""
LARGE: Final = Need("bytes a picture", f"{_SMALL} or more, by a larger --size", lambda fact: fact >= _SMALL)


def times_as_long(part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the ratio of the mean times of HTTP and ROS, launch by launch and block by block."""
    http, ros = _blocks(part.cells)
    ratio = ratio_of_launches(http, ros, part.run.bootstrap_seed, "mean") or Ratio(None, None, None)
    return [ratio], interval(ratio)


def times_as_large(part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the ratio of the mean bodies with and without Base64."""
    ratio = _bytes(part.cells[0]) / _bytes(part.cells[1])
    return [exact(ratio)], f"{ratio:.4f}"


def shares(
    side: int, groups: Mapping[str, tuple[Sequence[str], Sequence[str]]], part: RunPart
) -> tuple[list[Ratio], str]:
    """Measure the shares of groups of stages in the time of one side: name -> (stages, groups of the whole).

    Without groups the whole is the time without inference.
    """
    cell: RequestCell = part.cells[side]
    whole, seed = cell.values(_METRIC), part.run.bootstrap_seed
    spent = {stage: _spent(cell, [stage]).sum() for stage, of in cell.stages.items() if of != "inference"}
    ratios = []
    for stages, within in groups.values():
        each, base = _spent(cell, stages), _spent(cell, [stage for stage, of in cell.stages.items() if of in within])
        ratios.append(change(each, base if within else whole, seed, paired=True).ratio if each.any() else exact(0.0))
    spread = ["" if each.low is None else f" [{each.low:.0%}, {each.high:.0%}]" for each in ratios]
    texts = [f"{each.value or 0:.0%}{more}{name}" for each, more, name in zip(ratios, spread, groups, strict=True)]
    return ratios, f"{', '.join(texts)} of {cell.name}; the longest stage is {max(spent, key=spent.__getitem__)}"


def _spent(cell: RequestCell, stages: Sequence[str]) -> Floats:
    """Return the sum of stages in ms, for each sample that has the metric."""
    spent_ns = np.zeros(cell.n)
    for stage in stages:
        spent_ns += np.nan_to_num(cell.column(f"{stage}_ns"))
    return spent_ns[~np.isnan(cell.column(_METRIC))] / 1e6


def _bytes(cell: RequestCell) -> float:
    return float(cell.values("payload_bytes").mean())


def _metric(pair: Sequence[RequestCell]) -> str:
    """Return the metric: the `ingest` of a llama-server includes work that other engines count as inference."""
    return "e2e_without_model" if any(cell.has_ingest for cell in pair) else _METRIC


def _blocks(pair: Sequence[RequestCell]) -> tuple[Mapping[int, Blocks], Mapping[int, Blocks]]:
    """Return the values of both sides by launch, of the blocks that both have."""
    http, ros = (cell.by_launch(_metric(pair)) for cell in pair)
    both = [launch for launch in http if launch in ros]
    return (
        {launch: http[launch].shared(ros[launch]) for launch in both},
        {launch: ros[launch].shared(http[launch]) for launch in both},
    )


def speeds(run: StoredRun) -> Iterator[RunPart]:
    """Yield every cell that has a rate."""
    for speed in throughput_cells(run):
        if speed.values("tokens_per_s").size:
            source = {"T_eval": "the engine's" if speed.has_engine_time else "the client's"}
            facts = facts_of(run, [speed.origin]) | source
            yield RunPart(run, facts, [speed.origin], _launches(speed), speed)


KNOWN: Final = Need("quantisation", "known (the paper does not say which it used)", lambda fact: fact != UNKNOWN)


def speed_over(board: Published, part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the ratio of tokens a second to those of the paper's board.

    Fewer bits a weight take less time: the interval is open where the paper's quantisation may explain the difference.
    """
    values = part.cells.values("tokens_per_s")
    ratio = change(values, np.full(len(values), board.mean), part.run.bootstrap_seed).ratio
    rate, quantisation = summarise(values), part.facts["quantisation"]
    bits = int(match[1]) if (match := _BITS.search(quantisation)) else (FEWEST_BITS + MOST_BITS) // 2
    if ratio.high is not None and ratio.high < 1 - NEAR and bits > FEWEST_BITS:
        ratio = Ratio(ratio.value, ratio.low, inf)
    elif ratio.low is not None and ratio.low > 1 + NEAR and bits < MOST_BITS:
        ratio = Ratio(ratio.value, 0, ratio.high)
    return [ratio], f"{part.cells.name}: {mean_sd(rate)} tokens/s at {quantisation} (n = {rate.n})"
