"""Sources of latencies: what `boards.latency` reads, a run folder, a profile; and the export of delays."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.boards.gaps import Gaps
from s2a_bench.boards.latency import draw_ns, read_latency, whole_ns
from s2a_bench.boards.profile import load_profile, profile_files
from s2a_bench.boards.tokens import AS_PROFILE, board_of_profile
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.provenance import Provenance
from s2a_bench.store.run import StoredRun, fits, read_run

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.plugins.chunks.modes import ControlSetting, Ints, Mode
    from s2a_bench.trace import Mark

_PARAMETER: Final = re.compile(r"\s*\w+\s*=")


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Named latencies: drawn from ``gaps`` or from ``tokens`` of a profile, or ``recorded_ns``."""

    name: str
    gaps: Gaps | None = None
    recorded_ns: Ints | None = None
    profile: str = ""
    tokens: int = 0
    origin: Provenance = field(default_factory=Provenance.computed)
    requests: tuple[Mapping[str, object], ...] = ()
    """Measured requests, as the columns of `COLUMNS`."""
    service_ns: Ints | None = None
    """Service times of measured requests, as `service_of`: shape (R, 3)."""
    horizons: tuple[int, ...] = ()
    """How many actions measured answers have; empty for tokens."""

    @property
    def provenance(self) -> Provenance:
        return replace(self.origin, profile=self.name)

    def learnable(self, most: int) -> int:
        """Return how many latencies rules learn from: at most ``most``, and the first half of a recording."""
        return most if self.recorded_ns is None else min(most, self.recorded_ns.size // 2)

    def draw(self, rng: np.random.Generator, count: int) -> Ints:
        """Draw latencies of shape (count,), in ns; raises TypeError for a recording."""
        if self.profile:
            board = board_of_profile(load_profile(self.profile), AS_PROFILE, None)
            return whole_ns(board.tokens(self.tokens, rng, count)[-1])
        if self.gaps is None:
            raise TypeError(f"{self.name} is a recording")
        return draw_ns(self.gaps, rng, count)


def sources(written: str, tokens: int) -> Iterator[Source]:
    """Yield the sources of one written name; raises S2AError naming the field.

    A run folder has a source a cell, FOLDER#CELL is one of them. ``tokens`` are those of a chunk, for a profile.
    """
    if (read := read_latency(written)) is not None:
        yield Source(written, recorded_ns=read) if isinstance(read, np.ndarray) else Source(written, read)
    elif Path(folder := written.partition("#")[0]).is_dir():
        yield from measured(Path(folder), written.partition("#")[2])
    else:
        if written not in profile_files() and not (written.endswith(".toml") and Path(written).is_file()):
            kinds = "a number of ms, a family, a .csv file, a run folder, or a profile of 'profile list'"
            raise UsageError(f"`latency`: '{written}' should be {kinds}")
        yield Source(written, profile=written, tokens=tokens, origin=load_profile(written).provenance)


def split(value: object) -> object:
    """Split text at the commas between sources, not at those of a family's parameters; drop duplicates."""
    if not isinstance(value, str):
        return tuple(map(str, value)) if isinstance(value, (list, tuple)) else (str(value),)
    names: list[str] = []
    for text in (text.strip() for text in value.split(",") if text.strip()):
        if names and ":" in names[-1] and _PARAMETER.match(text):
            names[-1] += f",{text}"
        else:
            names.append(text)
    return tuple(dict.fromkeys(names))


def measured(folder: Path, only: str = "") -> Iterator[Source]:
    """Yield the latencies of each cell of a latency or throughput run, or of one, in time order.

    Failed requests and warm-ups are left out. Raises StoreError without a run, UsageError without answers or cell.
    """
    run = read_run(folder)
    with fits(run):
        samples = run.samples
        good = samples[~samples["warmup"] & (samples["error"] == "") & samples["e2e_ns"].notna()]
        cells = list(good["cell"].unique())
        if not cells:
            raise UsageError(
                f"`latency`: {folder} holds no answers; give the run folder of a latency or throughput run"
            )
        if only and only not in cells:
            raise UsageError(f"`latency`: {folder} has no cell '{only}', only {', '.join(cells)}")
        spans = _pieces(run)
        actions = run.manifest["configuration"].get("engine", {}).get("answer") == "actions"
        for cell in [only] if only else cells:
            answered, of_cell = run.origins.of(cell), good[good["cell"] == cell]
            timed = [_request(row, run, spans) for row in of_cell.to_dict("records")]
            yield Source(
                f"{folder}#{cell}{answered.over}",
                recorded_ns=np.array([request["latency_ns"] for request, _ in timed], np.int64),
                origin=Provenance.computed("", answered.weights, answered.pictures),
                requests=tuple({**request, "provenance": run.origins.of_row(cell)} for request, _ in timed),
                service_ns=np.array([service for _, service in timed], np.int64),
                horizons=tuple(sorted(of_cell["n_tokens"].unique().tolist())) if actions else (),
            )


def _request(
    row: Mapping[Any, Any], run: StoredRun, pieces: Mapping[str, tuple[int, int | None]]
) -> tuple[dict[str, Any], tuple[int, int, int]]:
    """Return the times of a request, from its marks at the ends of groups of stages, null without; and `service_of`."""
    marks = json.loads(row["marks"])
    ends = {run.stages.get(stage, ""): at_ns for stage, at_ns in marks}
    streaming_ns, last_engine_ns = pieces.get(row["request_id"], (0, None))
    latency_ns = int(row["e2e_ns"]) + streaming_ns
    one_clock = _whole(row.get("clock_error_ns")) is None
    times = {
        "observation_ns": marks[0][1],
        "sent_ns": ends.get("pack"),
        "server_in_ns": ends.get("network") if one_clock else None,
        "server_out_ns": last_engine_ns or ends.get("inference") if one_clock else None,
        "received_ns": marks[0][1] + latency_ns,
        "bytes": _whole(row["payload_bytes"]),
        "latency_ns": latency_ns,
    }
    return times, service_of(marks, run.stages, last_engine_ns, latency_ns)


def service_of(
    marks: Sequence[Mark], stages: Mapping[str, str], last_ns: int | None, latency_ns: int
) -> tuple[int, int, int]:
    """Return the times of a request from the engine's start to its first and to its last piece, and those beside it.

    Waiting in the queue is in none of them. The engine of a server that sends no marks counts as busy all the time.
    ``stages`` are stage -> group, ``last_ns`` is when the last piece left the engine.
    """
    spent = [(stages.get(stage, ""), before_ns, at_ns) for (_, before_ns), (stage, at_ns) in pairwise(marks)]
    engine = [(before_ns, at_ns) for group, before_ns, at_ns in spent if group == "inference"]
    if not engine:
        return marks[-1][1] - marks[0][1], latency_ns, 0
    began_ns, first_ns = engine[0][0], engine[-1][1]
    whole_ns = max(last_ns or 0, first_ns) - began_ns
    queue_ns = sum(at_ns - before_ns for group, before_ns, at_ns in spent if group == "queue")
    return first_ns - began_ns, whole_ns, max(0, latency_ns - whole_ns - queue_ns)


def _pieces(run: StoredRun) -> dict[str, tuple[int, int | None]]:
    """Return for each request the time from the first to the last piece, and when that left the engine."""
    times: pd.DataFrame = run.tokens.groupby("request_id").agg(
        first=("client_ns", "min"), last=("client_ns", "max"), left=("engine_ns", "max")
    )
    return {str(name): (int(last - first), _whole(left)) for name, first, last, left in times.itertuples()}


def _whole(value: Any) -> int | None:
    import pandas as pd

    return None if pd.isna(value) else int(value)


COLUMNS: Final = (
    "request",
    "observation_ns",
    "sent_ns",
    "server_in_ns",
    "server_out_ns",
    "received_ns",
    "bytes",
    "latency_ns",
    "d",
    "rounding",
    "delta_t_ns",
    "provenance",
)
"""Columns of the exported delays, a row a request, which docs/chunks.md explains; `boards.latency` reads the file."""


def write_delays(path: Path, source: Source, drawn_ns: Ints, mode: Mode, setting: ControlSetting) -> None:
    """Write the requests of a source as CSV, or those of ``mode`` with drawn latencies; raises StoreError."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(_delays(source, drawn_ns, mode, setting))
    except OSError as error:
        raise StoreError(f"`export_delays`: cannot write {path}: {error}") from error


def _delays(source: Source, drawn_ns: Ints, mode: Mode, setting: ControlSetting) -> Iterator[dict[str, object]]:
    requests = source.requests or list(_simulated(drawn_ns, mode, setting))
    delays = setting.delay_ticks(np.array([request["latency_ns"] for request in requests], np.int64))
    for number, (request, delay) in enumerate(zip(requests, delays.tolist(), strict=True)):
        yield {
            "request": number,
            "provenance": source.provenance.code,
            **request,
            "d": delay,
            "rounding": setting.rounding,
            "delta_t_ns": setting.period_ns,
        }


def _simulated(drawn_ns: Ints, mode: Mode, setting: ControlSetting) -> Iterator[dict[str, object]]:
    request_ns = mode.cycles(drawn_ns, setting).request_tick * setting.period_ns
    for at_ns, latency_ns in zip(request_ns.tolist(), drawn_ns.tolist(), strict=True):
        yield {"observation_ns": at_ns, "received_ns": at_ns + latency_ns, "latency_ns": latency_ns}
