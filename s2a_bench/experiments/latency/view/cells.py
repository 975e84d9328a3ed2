"""What a run says about each of its cells: the samples that count, their summaries, and the ratios between cells.

Warm-ups and failed samples are counted and take part in no summary.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from s2a_bench.provenance import UNKNOWN, Provenance
from s2a_bench.stats import Ratio
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.trace import GROUPS, RESIDUAL_LIMIT
from s2a_bench.transport import declared
from s2a_bench.writers.tables import DUMMY, ECHO, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from s2a_bench.store.run import Run

    Floats: TypeAlias = NDArray[np.float64]
    Split: TypeAlias = Sequence[tuple[Run, list["Cell"]]]

RATIO_METRICS = ("e2e_without_inference", "e2e_without_model", "e2e")
"""What cells are compared by: columns of the samples, less the unit."""

EARLIER_PAYLOADS = {"bgr": "raw", "compressed": "jpeg"}
"""Words of older folders for how a picture travels over ROS -> today's."""

_NS_PER_MS = 1e6


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a run; ``good`` holds the samples that count, in the order in which they were taken."""

    name: str
    about: dict[str, str]
    good: pd.DataFrame
    tokens: pd.DataFrame
    warmups: int
    errors: int
    stages: Mapping[str, str]
    """Stage -> group of the run, in the order of the path."""
    emulated: bool
    """Whether the engine's times come from a profile, or from latencies that were given."""

    @property
    def n(self) -> int:
        """Count the samples that count."""
        return len(self.good)

    @property
    def pipeline(self) -> str:
        """Name the transport."""
        return self.about["pipeline"]

    @property
    def path(self) -> tuple[str, str]:
        """Return transport and variant."""
        return self.about["pipeline"], self.about["variant"]

    def is_compared_with(self, base: Cell) -> bool:
        """Whether the transport declares that its cells are divided by those of another."""
        return base.pipeline in declared(self.pipeline).compared_with

    def values_ms(self, metric: str) -> Floats:
        """Return the values of a stage, or of another column less ``_ns``, in ms."""
        return numbers_ms(self._column(metric))

    def _column(self, metric: str) -> pd.Series[Any]:
        """Return a column of ns; that of a stage which the run's transports do not have is empty."""
        name = f"{metric}_ns"
        return self.good[name] if name in self.good else self.good["frame_index"].iloc[:0]

    @property
    def has_ingest(self) -> bool:
        """Return whether the server is a llama-server, seen from outside."""
        return bool(self.group_ms("ingest").size)

    def group_ms(self, group: str) -> Floats:
        """Return the sums, in ms, of the stages of a group; a sample without such stages has none."""
        names = [f"{stage}_ns" for stage, of in self.stages.items() if of == group]
        return _numbers(self.good[names].sum(axis=1, min_count=1)) / _NS_PER_MS

    def residual_shares(self) -> Floats:
        """Return the residuals as shares of e2e without inference."""
        return _numbers(self.good["residual_share"])

    def flagged(self) -> int:
        """Count the samples whose residual is too large a share."""
        return int((self.residual_shares() > RESIDUAL_LIMIT).sum())

    @property
    def answers(self) -> pd.DataFrame:
        """Return the tokens of the samples that count, request by request in order, with two times of each in ns.

        ``gap_ns`` since the token before, as the client saw both, none of the first; ``delay_ns`` since it left the
        engine.
        """
        tokens = self.tokens[self.tokens["request_id"].isin(self.good["request_id"])]
        tokens = tokens.sort_values(["request_id", "index"])
        gap_ns = tokens.groupby("request_id")["client_ns"].diff()
        return tokens.assign(gap_ns=gap_ns, delay_ns=tokens["client_ns"] - tokens["engine_ns"])

    def itl_ms(self) -> Floats:
        """Return the times between a token and the next as the client saw them, of all requests, in ms."""
        return numbers_ms(self.answers["gap_ns"])

    def token_delay_ms(self) -> Floats:
        """Return the times from a token's leaving the engine to the client's seeing it, of all requests, in ms."""
        return numbers_ms(self.answers["delay_ns"])

    def by_launch(self, metric: str) -> dict[int, dict[int, list[float]]]:
        """Return the values of a metric in ms by the launch and the block in which they were taken."""
        values = self._column(metric).dropna()
        return by_launch(self.good.loc[values.index], values / _NS_PER_MS)


def by_launch(places: pd.DataFrame, values: Iterable[Any]) -> dict[int, dict[int, list[float]]]:
    """Collect values by their places' columns ``launch`` and ``block``."""
    found: dict[int, dict[int, list[float]]] = {}
    for launch, block, value in zip(places["launch"], places["block"], values, strict=True):
        found.setdefault(int(launch), {}).setdefault(int(block), []).append(float(value))
    return found


def numbers_ms(column: pd.Series[Any]) -> Floats:
    """Return a column of ns in ms, the missing values left out."""
    return _numbers(column) / _NS_PER_MS


def cells_of(run: Run) -> list[Cell]:
    """Split a run into its cells, in the order that their transports declare, then by name."""
    return _cells(run, with_launch(run.samples))


def split(runs: Iterable[Run]) -> Split:
    """Return runs, each with its cells."""
    return [(run, cells_of(run)) for run in runs]


def launches_of(run: Run) -> list[tuple[int, list[Cell]]]:
    """Return launch and cells for every launch of a run."""
    samples = with_launch(run.samples)
    return [(int(launch), _cells(run, samples[samples["launch"] == launch])) for launch in samples["launch"].unique()]


def with_launch(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the launch of each; folders from before there were several have the launch 0."""
    return rows.assign(launch=rows["launch"].fillna(0))


def _cells(run: Run, samples: pd.DataFrame) -> list[Cell]:
    tokens, stages = run.tokens, run.stages
    cells = [
        _cell(str(name), samples[samples["cell"] == name], tokens[tokens["cell"] == name], stages, run.origins.of(name))
        for name in samples["cell"].unique()
    ]
    return sorted(cells, key=_place)


def ratios(cells: list[Cell], seed: int) -> Iterator[tuple[str, Cell, Cell, Ratio]]:
    """Yield metric, cell, base and ratio: every cell over those of the transports that its own is compared with.

    A pair is left out where a cell lacks the metric, as e2e without inference behind a black box.
    """
    for metric in RATIO_METRICS:
        for base in cells:
            for cell in cells:
                if cell.is_compared_with(base) and (ratio := ratio_between(cell, base, metric, seed)):
                    yield metric, cell, base, ratio


def ratio_between(cell: Cell, base: Cell, metric: str, seed: int) -> Ratio | None:
    """Divide the medians of two cells, launch by launch and block by block.

    None where they cannot be compared: a llama-server's `ingest` slices and resizes the picture, which our engine
    counts as inference, so that e2e without inference does not mean the same on both sides.
    """
    if metric == "e2e_without_inference" and cell.has_ingest != base.has_ingest:
        return None
    return ratio_of_launches(cell.by_launch(metric), base.by_launch(metric), seed)


def asked(run: Run, cells: list[Cell]) -> str:
    """Return what each request brings, in words: the pictures' sizes, how many, and the robot's state."""
    sizes = sorted({cell.about["size"] for cell in cells})
    return str(run.manifest["configuration"].get("observation") or ", ".join(sizes))


def pieces_of(run: Run) -> str:
    """Return what answers are made of: tokens or actions; a folder from before there were actions has tokens."""
    engine: dict[str, Any] = run.manifest["configuration"].get("engine") or {}
    return "actions" if engine.get("answer") == "actions" else "tokens"


def chunks(run: Run) -> str:
    """Return the shape of each answer, in words, where answers are chunks of actions that an engine of ours makes."""
    return str((run.manifest.get("model") or {}).get("answer") or "")


def engine_note(run: Run, cells: list[Cell]) -> Note:
    """Return what did not really answer: an echo, a replayed profile, dummy weights; empty where a model did."""
    engines = {cell.about["engine"] for cell in cells}
    notes = []
    if "echo" in engines:
        notes.append(Note("echo engine", ECHO))
        origins = [run.origins.of(cell.name) for cell in cells if cell.about["engine"] == "echo"]
        drawn = dict.fromkeys(origin.profile for origin in origins if origin.emulated)
        notes += [Note(f"EMULATED: {latencies}", EMULATED) for latencies in drawn]
    if "replay" in engines:
        notes.append(_emulated(_replayed(run, cells)))
    answered = [cell.name for cell in cells if cell.about["engine"] != "replay"]
    if any(run.origins.of(name).weights == "dummy" for name in answered):
        notes.append(Note("dummy weights", DUMMY))
    if UNKNOWN in engines:
        notes.append(Note("engine unknown, as the server does not tell", "engine unknown"))
    return Note(", ".join(notes), *(label for note in notes for label in note.labels))


def stand_ins(runs: Split) -> list[str]:
    """Return what did not really answer runs, a sentence each."""
    return sorted({note.sentence() for run, cells in runs if (note := engine_note(run, cells))})


def _replayed(run: Run, cells: list[Cell]) -> dict[str, Any]:
    """Return what is known of the profile that was played: by a server of ours, or by one that told in its answers."""
    model: dict[str, Any] = run.manifest.get("model") or {}
    if model.get("engine") == "replay":
        return model
    told = next((origin for cell in cells if (origin := run.origins.of(cell.name)).engine == "replay"), None)
    return {"profile": told.profile, "dummy": told.weights == "dummy"} if told else model


def _emulated(model: dict[str, Any]) -> Note:
    """Return which board was played, how, and where its rate is from."""
    note = f"EMULATED: replayed profile {model.get('profile', '')}".rstrip()
    said = [Note(f"{model['gaps']} gaps")] if "gaps" in model else []
    said += [Note("the paper's rate", PAPERS)] if model.get("origin") == "paper" else []
    said += [Note("recorded with dummy weights", DUMMY)] if model.get("dummy") else []
    labels = (label for more in said for label in more.labels)
    return Note(f"{note} ({', '.join(said)})" if said else note, EMULATED, *labels)


def groups_present(cells: list[Cell]) -> list[str]:
    """List the groups that some sample has, in the order of the path."""
    return [group for group in GROUPS if any(cell.group_ms(group).size for cell in cells)]


def stages_present(cells: list[Cell]) -> list[str]:
    """List the stages that some sample has, in the order of the path."""
    stages = cells[0].stages if cells else ()
    return [stage for stage in stages if any(cell.values_ms(stage).size for cell in cells)]


def _cell(
    name: str, samples: pd.DataFrame, tokens: pd.DataFrame, stages: Mapping[str, str], origin: Provenance
) -> Cell:
    """Sort the samples of one cell into those that count and those that are only counted."""
    about = {
        key: str(samples[key].iloc[-1])  # who answers may be known from the first answer on
        for key in ("pipeline", "variant", "payload", "connection", "engine", "mode", "size")
    }
    about["payload"] = EARLIER_PAYLOADS.get(about["payload"], about["payload"])
    failed = samples["error"] != ""
    good = samples[~samples["warmup"] & ~failed]
    errors = int((failed & ~samples["warmup"]).sum())
    emulated = origin.emulated or about["engine"] == "replay"  # which older folders do not tell otherwise
    return Cell(name, about, good, tokens, int(samples["warmup"].sum()), errors, stages, emulated)


def _place(cell: Cell) -> tuple[float, str, int, str]:
    """Sort by the transport's order, its variants in theirs, then by name."""
    transport, variant = declared(cell.pipeline), cell.about["variant"]
    known = transport.variants.index(variant) if variant in transport.variants else len(transport.variants)
    return transport.order, cell.pipeline, known, cell.name


def _numbers(column: pd.Series[Any]) -> Floats:
    return column.dropna().to_numpy(dtype="float64")
