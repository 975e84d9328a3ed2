"""What the paper's claims about transports are judged by: HTTP/JSON beside ROS, stage by stage."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.latency.view.cells import Cell, cells_of
from s2a_bench.experiments.paper import paper_latency
from s2a_bench.report.claims.claim import CONTRADICTED, SUPPORTED, UNDECIDED, Claim, Need, Part, Said, within
from s2a_bench.report.claims.intervals import LIKE, TOO_FEW, change, verdict_of
from s2a_bench.report.claims.needs import on_board, told
from s2a_bench.stats import Ratio, summary_of
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.writers.tables import interval, mean_sd, number

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from s2a_bench.report.claims.intervals import Floats
    from s2a_bench.stats.change import Blocks
    from s2a_bench.store.run import Run

_METRIC: Final = "e2e_without_inference"
_HTTP, _BINARY, _ROS = "http/as-deployed", "http/binary", "ros"
_BASE64: Final = ("base64_encode", "base64_decode")
_JSON: Final = ("json_pack", "json_parse")
_DECODE: Final = ("image_decode",)
_NETWORK: Final = ("connect", "network")
_COLOURS: Final = ("convert", "channel_swap")
_EXPANSION: Final = 4 / 3
_EXPANSION_ROOM: Final = 0.01
"""The body holds the prompt and JSON's own characters besides."""
_SMALL_BYTES: Final = 50_000
_HALF: Final = 0.5
_RUN: Final = "s2a-bench latency --transport http?payload=jpeg-preencoded,ros"
_SETTING: Final = "pre-encoded JPEG over HTTP, colours converted for ROS, inference left out"


def _pairs(run: Run) -> Iterator[Part]:
    """Yield HTTP as usually deployed with ROS, every cell of one with every cell of the other."""
    cells = [cell for cell in cells_of(run) if cell.values_ms(_METRIC).size and not cell.has_ingest]
    https = [cell for cell in cells if "/".join(cell.path) == _HTTP]
    for http, ros in product(https, [cell for cell in cells if cell.pipeline == _ROS]):
        yield _part(run, http, ros)


def _bodies(run: Run) -> Iterator[Part]:
    """Yield HTTP with Base64 and without, of the same payload and size."""
    cells = [cell for cell in cells_of(run) if cell.good["payload_bytes"].notna().any()]
    coded, plain = ([cell for cell in cells if "/".join(cell.path) == path] for path in (_HTTP, _BINARY))
    for one, other in product(coded, plain):
        if all(one.about[name] == other.about[name] for name in ("payload", "size")):
            yield _part(run, one, other)


def _part(run: Run, one: Cell, other: Cell) -> Part:
    origins = tuple(run.origins.of(cell.name) for cell in (one, other))
    return Part(run, f"{one.name}, {other.name}", (one, other), origins)


def _about(name: str, key: str, *wanted: tuple[str, ...]) -> Need:
    """Need the cells of a pair, in turn, to have one of these values."""

    def look(part: Part) -> tuple[bool, str]:
        values = [cell.about[key] for cell in part.cells]
        return all(value in each for value, each in zip(values, wanted, strict=True)), " and ".join(
            dict.fromkeys(values)
        )

    return Need(name, " and ".join(dict.fromkeys(" or ".join(each) for each in wanted)), look)


_MODE: Final = _about("mode", "mode", ("request",), ("request",))
_PAYLOAD: Final = _about("payload", "payload", ("jpeg-preencoded",), ("raw", "yuyv"))
_LINK: Final = told("link", "link", "real")


def _slower(part: Part) -> Said:
    ratio = _ratio(part)
    return verdict_of(ratio, 1), f"{_both(part)} {interval(ratio)} times as long." if ratio.low else TOO_FEW


def _by_so_much(part: Part) -> Said:
    ratio = _ratio(part)
    http, ros = paper_latency()
    claimed = http.mean_ms / ros.mean_ms
    said = f"Ours: {interval(ratio)}; the paper: {claimed:.2f}. {_both(part)}"
    return verdict_of(ratio, claimed * (1 - LIKE), claimed * (1 + LIKE)), said if ratio.low else f"{said} {TOO_FEW}"


def _serialisation(part: Part) -> Said:
    """Judge figure 6 for HTTP twice: the paper merges JSON pack with the POST, which holds the network."""
    http, seed = part.cells[0], part.run.bootstrap_seed
    stages = (*_BASE64, *_JSON, *_DECODE)
    merged, alone = (_share(http, names, seed) for names in ((*stages, *_NETWORK), stages))
    verdicts = {_majority(merged), _majority(alone)}
    said = (
        f"{http.name}, of {number(float(http.values_ms(_METRIC).mean()))} ms: {_percent(merged)} with the network "
        f"(merged with JSON pack, as in figure 6), {_percent(alone)} without it."
    )
    return verdicts.pop() if len(verdicts) == 1 else UNDECIDED, said


def _conversions(part: Part) -> Said:
    ros = part.cells[1]
    share = _share(ros, _COLOURS, part.run.bootstrap_seed)
    spent = {stage: float(_spent(ros, [stage]).sum()) for stage, of in ros.stages.items() if of != "inference"}
    longest = max(spent, key=lambda stage: spent[stage])
    said = (
        f"{ros.name}: YUYV to BGR and BGR to RGB take {_percent(share)} of "
        f"{number(float(ros.values_ms(_METRIC).mean()))} ms; the longest stage is {longest}."
    )
    return _majority(share), said


def _base64(part: Part) -> Said:
    coded, plain = (float(cell.good["payload_bytes"].dropna().mean()) for cell in part.cells)
    ratio = coded / plain
    said = (
        f"The bodies weigh {coded:,.0f} bytes with Base64 and JSON, {plain:,.0f} as binary: {ratio:.4f} times, "
        "the prompt and JSON's own characters included."
    )
    if plain < _SMALL_BYTES:
        return UNDECIDED, f"{said} These pictures are too small to tell: use a larger --size."
    return SUPPORTED if abs(ratio / _EXPANSION - 1) <= _EXPANSION_ROOM else CONTRADICTED, said


def _ratio(part: Part) -> Ratio:
    """Return how much longer HTTP takes in the mean, launch by launch and block by block."""
    http, ros = (cell.by_launch(_METRIC) for cell in part.cells)
    shared = _shared(http, ros), _shared(ros, http)
    return ratio_of_launches(*shared, part.run.bootstrap_seed, "mean") or Ratio(None, None, None)


def _shared(cell: Mapping[int, Blocks], other: Mapping[int, Blocks]) -> dict[int, Blocks]:
    """Return the blocks of a cell that the other has too."""
    return {
        launch: {block: values for block, values in blocks.items() if block in other.get(launch, {})}
        for launch, blocks in cell.items()
    }


def _share(cell: Cell, stages: Sequence[str], seed: int) -> Ratio:
    """Return what share of a cell's time, inference left out, these stages take."""
    part, whole = _spent(cell, stages), cell.values_ms(_METRIC)
    if not part.any():
        return Ratio(0.0, 0.0, 0.0)
    return change(part, whole, seed, paired=True).ratio


def _majority(share: Ratio) -> str:
    """Judge whether a share is more than half; half is not."""
    if share.low is None or share.high is None:
        return UNDECIDED
    return CONTRADICTED if share.high <= _HALF else within(share.low, share.high, _HALF)


def _spent(cell: Cell, stages: Sequence[str]) -> Floats:
    """Return what stages took together, one value a sample that has the metric, in ms."""
    good = cell.good[cell.good[f"{_METRIC}_ns"].notna()]
    names = [f"{stage}_ns" for stage in stages if f"{stage}_ns" in good]
    spent: Floats = good[names].fillna(0).sum(axis=1).to_numpy(dtype="float64") / 1e6
    return spent


def _percent(share: Ratio) -> str:
    if share.low is None or share.high is None:
        return f"{share.value or 0:.0%} ({TOO_FEW.lower().removesuffix('.')})"
    return f"{share.value:.0%} [{share.low:.0%}, {share.high:.0%}]"


def _both(part: Part) -> str:
    """Return what both take, and of how many samples."""
    found = [(cell, summary_of(cell.values_ms(_METRIC))) for cell in part.cells]
    texts = [f"{cell.name} {mean_sd(each)} ms" for cell, each in found if each]
    return f"{', '.join(texts)} (mean ± sd, n = {part.cells[0].n})."


LATENCY_CLAIMS: Final[tuple[Claim, ...]] = (
    Claim(
        "V-B, figure 4",
        "HTTP/JSON takes longer end to end than ROS 2-native",
        f"The 95 % interval of the ratio of means is above 1 (supported) or below (contradicted); {_SETTING}.",
        "latency",
        _RUN,
        _pairs,
        (_MODE, _PAYLOAD, _LINK),
        _slower,
    ),
    Claim(
        "V-B, figure 4",
        "101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin",
        f"The 95 % interval of the ratio of means lies within {LIKE:.0%} of 6.57 (supported) or wholly outside "
        f"(contradicted); {_SETTING}.",
        "latency",
        f"{_RUN} (on a Jetson AGX Orin)",
        _pairs,
        (on_board("Jetson AGX Orin"), _MODE, _PAYLOAD, _LINK),
        _by_so_much,
    ),
    Claim(
        "V-C, figure 6",
        "Most HTTP overhead is repeated serialisation (Base64, JSON) and server-side decoding",
        "Base64, JSON and image decode take more than half of the mean, with the network counted in, as the paper "
        "merges it with JSON pack, and without it; undecided where the two differ or a 95 % interval holds one half. "
        "Any machine; the paper shows it on an AGX Orin.",
        "latency",
        _RUN,
        _pairs,
        (_MODE, _PAYLOAD, _LINK),
        _serialisation,
    ),
    Claim(
        "V-C, figure 6",
        "ROS latency is dominated by lightweight colour conversions",
        "YUYV to BGR and BGR to RGB take more than half of the mean; undecided where the 95 % interval holds one half. "
        "Any machine; the paper shows it on an AGX Orin.",
        "latency",
        _RUN,
        _pairs,
        (_MODE, _PAYLOAD, _LINK),
        _conversions,
    ),
    Claim(
        "III-A",
        "Base64 makes a picture 1.3333 times as large",
        f"Mean body of {_HTTP} over {_BINARY}, same payload and size, within {_EXPANSION_ROOM:.0%} of 4/3; pictures of "
        f"{_SMALL_BYTES:,} bytes or more.",
        "latency",
        "s2a-bench latency --http as-deployed,binary",
        _bodies,
        (_MODE,),
        _base64,
    ),
)
"""Claims about transports."""
