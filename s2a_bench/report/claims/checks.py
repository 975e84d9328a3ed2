"""What each claim of the paper is judged by: latency, throughput, boundary; timelines and CCRB stand beside."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.boundary.rows import BOUNDARY
from s2a_bench.experiments.latency.view.cells import Cell, cells_of, ratio_between
from s2a_bench.experiments.paper import paper_latency, paper_throughput
from s2a_bench.report.claims.ccrb import CCRB_CLAIMS
from s2a_bench.report.claims.claim import CONFIRMED, REFUTED, UNTESTABLE, Claim, Finding
from s2a_bench.report.claims.timelines import TIMELINE_CLAIMS
from s2a_bench.stats import summary_of
from s2a_bench.writers.tables import interval, mean_sd, number

if TYPE_CHECKING:
    from s2a_bench.experiments.paper import PaperThroughput
    from s2a_bench.store.run import Run

_METRIC: Final = "e2e_without_inference"
_LIKE: Final = 0.10
"""The paper gives no spread for tokens/s: ours is called the same within this share."""
_EXPANSION: Final = 4 / 3
_EXPANSION_ROOM: Final = 0.01
"""The body holds the prompt and JSON's own characters besides."""
_SMALL_BYTES: Final = 50_000
_LATENCY: Final = "s2a-bench latency --transport http?payload=jpeg-preencoded,ros"
_HALF: Final = 0.5


def _slower(run: Run) -> Finding | None:
    """Judge that HTTP/JSON takes longer than ROS, which any machine can tell."""
    pair = _pair(run)
    if pair is None:
        return None
    http, ros = pair
    ratio = ratio_between(http, ros, _METRIC, run.bootstrap_seed)
    if ratio is None or ratio.low is None or ratio.high is None:
        return Finding(UNTESTABLE, "Too few samples for an interval of the ratio.")
    said = f"{_medians(http, ros)} {http.name} over {ros.name}: {interval(ratio)} (95 % interval of the ratio)."
    return Finding(CONFIRMED if ratio.low > 1 else REFUTED, said)


def _ratio(run: Run) -> Finding | None:
    """Judge how much longer; only the paper's board can tell."""
    pair = _pair(run)
    if pair is None:
        return None
    http, ros = pair
    ratio = ratio_between(http, ros, _METRIC, run.bootstrap_seed)
    paper = [claim.mean_ms for claim in paper_latency()]
    claimed = paper[0] / paper[1]
    if ratio is None or ratio.low is None or ratio.high is None:
        return Finding(UNTESTABLE, "Too few samples for an interval of the ratio.")
    said = f"Ours: {interval(ratio)} with payload {http.about['payload']}, n = {http.n}. The paper: {claimed:.2f}."
    if not is_board(run, "Jetson AGX Orin"):
        return Finding(UNTESTABLE, f"{said} This is {machine_of(run)}, not a Jetson AGX Orin.")
    return Finding(CONFIRMED if ratio.low <= claimed <= ratio.high else REFUTED, said)


def _serialisation(run: Run) -> Finding | None:
    """Judge figure 6 for HTTP, with JSON pack and POST as one category, as the paper has them."""
    pair = _pair(run)
    if pair is None:
        return None
    parts = _means(pair[0])
    whole = sum(parts.values())
    base64 = sum(parts.get(stage, 0.0) for stage in ("base64_encode", "base64_decode"))
    post = sum(parts.get(stage, 0.0) for stage in ("json_pack", "connect", "network"))
    network = sum(parts.get(stage, 0.0) for stage in ("connect", "network"))
    server = sum(parts.get(stage, 0.0) for stage in ("json_parse", "image_decode"))
    share = (base64 + post + server) / whole
    said = (
        f"{pair[0].name}, means: Base64 {base64 / whole:.0%}, JSON pack and HTTP POST merged {post / whole:.0%} "
        f"(the network alone {network / whole:.0%}), JSON parse and image decode {server / whole:.0%} "
        f"of {number(whole)} ms; together {share:.0%}, without the network {share - network / whole:.0%}."
    )
    return Finding(CONFIRMED if share > _HALF else REFUTED, said)


def _conversions(run: Run) -> Finding | None:
    """Judge figure 6 for ROS."""
    pair = _pair(run)
    if pair is None:
        return None
    parts = _means(pair[1])
    whole = sum(parts.values())
    share = (parts.get("convert", 0.0) + parts.get("channel_swap", 0.0)) / whole
    longest = max((stage for stage in parts if stage), key=lambda stage: parts[stage])
    said = (
        f"{pair[1].name}, means: YUYV to BGR and BGR to RGB take {share:.0%} of {number(whole)} ms; "
        f"the longest stage is {longest} with {parts[longest] / whole:.0%}."
    )
    return Finding(CONFIRMED if share > _HALF else REFUTED, said)


def _base64(run: Run) -> Finding | None:
    """Judge what Base64 adds, by what the same pictures weigh with and without it."""
    weights = {cell.name: summary_of(_bytes(cell)) for cell in cells_of(run)}
    coded, plain = weights.get("http/as-deployed"), weights.get("http/binary")
    if coded is None or plain is None:
        return None
    ratio = coded.mean / plain.mean
    said = (
        f"The bodies weigh {coded.mean:,.0f} bytes with Base64 and JSON, {plain.mean:,.0f} as binary: {ratio:.4f} "
        "times, the prompt and JSON's own characters included."
    )
    if plain.mean < _SMALL_BYTES:
        return Finding(UNTESTABLE, f"{said} These pictures are too small to tell: use a larger --size.")
    near = abs(ratio / _EXPANSION - 1) <= _EXPANSION_ROOM
    return Finding(CONFIRMED if near else REFUTED, said)


def _rate(claim: PaperThroughput, run: Run) -> Finding | None:
    """Judge one row of table II on that board."""
    from s2a_bench.experiments.throughput.view.cells import speeds_of

    found = [(speed, rate) for speed in speeds_of(run) if (rate := summary_of(speed.values("tokens_per_s")))]
    if not found:
        return None
    speed, rate = found[0]
    said = f"Ours: {mean_sd(rate)} tokens/s ({speed.name}, n = {rate.n}); the paper: {claim.tokens_per_s:g}."
    model = run.manifest.get("model") or {}
    if speed.cell.emulated:
        return Finding(UNTESTABLE, f"EMULATED: the replayed profile {model.get('profile')} set the rate. {said}")
    if not is_board(run, claim.name):
        return Finding(UNTESTABLE, f"{said} This is {machine_of(run)}, another board.")
    if model.get("dummy"):
        return Finding(UNTESTABLE, f"Dummy weights answered, not the paper's model. {said}")
    near = abs(rate.mean / claim.tokens_per_s - 1) <= _LIKE
    return Finding(
        CONFIRMED if near else REFUTED,
        f"{said} Called the same within {_LIKE:.0%}; model {model.get('name', 'unknown')}.",
    )


def _suffices(run: Run) -> Finding | None:
    return _region(run, above=True)


def _required(run: Run) -> Finding | None:
    return _region(run, above=False)


def _region(run: Run, *, above: bool) -> Finding | None:
    """Try the points on one side of R = L / T_min, skills running for T_nom, as naive runs them."""
    from s2a_bench.experiments.boundary.view.tables import grid_of, is_random

    if run.table(BOUNDARY).empty:
        return None
    if is_random(run):
        return Finding(UNTESTABLE, "With jitter no line separates the regions; run without it.")
    least_s = float(grid_of(run, "t_min")["duration_s"].iloc[0])
    points = grid_of(run, "t_nom")
    on_side = points["tokens_per_s"] >= points["tokens_per_skill"] / least_s
    points = points[on_side if above else ~on_side]
    stalls = int((points["p_stall"] > 0).sum())
    nominal_s = float(points["duration_s"].iloc[0])
    said = (
        f"Naive stalls at {stalls} of {len(points)} points {'above' if above else 'below'} R = L/T_min ({least_s:g} s)."
    )
    if above:
        return Finding(REFUTED if stalls else CONFIRMED, said)
    if stalls == len(points):
        return Finding(CONFIRMED, said)
    return Finding(
        REFUTED,
        f"{said} The others are stall-free since skills run for T_nom ({nominal_s:g} s): the line is R = L/T_nom.",
    )


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


def _pair(run: Run) -> tuple[Cell, Cell] | None:
    """Return HTTP as usually deployed and ROS, where both are told apart from inference."""
    cells = {
        "/".join(cell.path): cell for cell in cells_of(run) if cell.values_ms(_METRIC).size and not cell.has_ingest
    }
    http = cells.get("http/as-deployed")
    ros = cells.get("ros/topic") or cells.get("ros/action")
    return (http, ros) if http and ros else None


def _medians(http: Cell, ros: Cell) -> str:
    """Return what both take, and of how many samples, with what payload."""
    found = [summary_of(cell.values_ms(_METRIC)) for cell in (http, ros)]
    texts = [f"{mean_sd(each)} ms" for each in found if each]
    return f"Without inference {' and '.join(texts)} (mean ± sd, n = {http.n}, payload {http.about['payload']})."


def _means(cell: Cell) -> dict[str, float]:
    """Return the mean of every stage but inference and of the residual over the cell's samples, in ms."""
    from s2a_bench.experiments.latency.view.cells import stages_present

    names = {stage: stage for stage in stages_present([cell]) if stage != "inference"} | {"": "residual"}
    return {name: float(cell.values_ms(column).sum()) / cell.n for name, column in names.items()}


def _bytes(cell: Cell) -> Any:
    return cell.good["payload_bytes"].dropna().to_numpy(dtype="float64")


CLAIMS: Final[tuple[Claim, ...]] = (
    Claim("V-B, figure 4", "HTTP/JSON takes longer end to end than ROS 2-native", "latency", _LATENCY, _slower),
    Claim(
        "V-B, figure 4",
        "101.8 against 15.5 ms: 6.57 times as long, on a Jetson AGX Orin",
        "latency",
        f"{_LATENCY} (on a Jetson AGX Orin)",
        _ratio,
    ),
    Claim(
        "V-C, figure 6",
        "Most HTTP overhead is repeated serialisation (Base64, JSON) and server-side decoding",
        "latency",
        _LATENCY,
        _serialisation,
    ),
    Claim(
        "V-C, figure 6", "ROS latency is dominated by lightweight colour conversions", "latency", _LATENCY, _conversions
    ),
    Claim(
        "III-A",
        "Base64 makes a picture 1.3333 times as large",
        "latency",
        "s2a-bench latency --http as-deployed,binary",
        _base64,
    ),
    *(
        Claim(
            "V-D, table II",
            f"{board.name}: {board.tokens_per_s:g} tokens/s",
            "throughput",
            f"s2a-bench throughput --model MINICPM.gguf --mmproj TOWER.gguf (on a {board.name})",
            partial(_rate, board),
        )
        for board in paper_throughput()
    ),
    Claim("IV-F, figure 2", "Where R >= L/T_min naive execution suffices", "boundary", "s2a-bench boundary", _suffices),
    Claim("IV-F, figure 2", "Below R = L/T_min stalls occur", "boundary", "s2a-bench boundary", _required),
    *TIMELINE_CLAIMS,
    *CCRB_CLAIMS,
)
