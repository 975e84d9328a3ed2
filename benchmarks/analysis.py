"""What it costs to look at a run: ``python -m benchmarks.analysis [--requests N ...] [--folder FOLDER]``.

Writes finished `latency` runs of 8 cells with 16 tokens a request, and times `report`, `compare` of a run with itself,
the library's `load` and `Run.samples`, each in a process of its own. Manifest, stages and chains of marks are those of
a measured run; every duration and fact is drawn around the measured one. A folder that is named keeps its runs, and
those that it has are not written again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np

    from s2a_bench.store.run import StoredRun
    from s2a_bench.store.schema import Table

REQUESTS: Final = (10_000, 72_000, 100_000, 1_000_000)
"""The second is 40 minutes at 30 Hz."""
CELLS: Final = 8
TOKENS: Final = 16
WARMUP_BLOCKS: Final = 5
MODEL: Final = Path("results/reference/transports/cells/0001-r1")
"""A run of this repository, whose manifest and rows the written ones resemble."""
CSV_UP_TO: Final = 100_000
"""A finished run has both files of a table; larger runs are written without the CSV."""
PERIOD_NS: Final = 33_333_333
BLOCKS_AT_ONCE: Final = 10_000
SPREAD: Final = 0.25
"""Of the drawn durations: the standard deviation of their logarithms."""
WORDS: Final = ("1", ".", " pick", "(", "cup", ")", "\n", "2", ".", " place", "(", "cup", ",", " table", ")", "\n")

MAIN: Final = "from s2a_bench.cli import main; main()"
LOAD: Final = "import sys, s2a_bench; run = s2a_bench.load(sys.argv[1])"


@dataclass(frozen=True, slots=True)
class Cost:
    """What one process took."""

    wall_s: float
    user_s: float
    peak_mb: float


def write_run(folder: Path, requests: int, *, csv: bool) -> None:
    """Write a finished run: its manifest, samples and tokens as Parquet, and as CSV too where ``csv``."""
    import numpy as np

    from s2a_bench.store.requests import TOKENS as TOKEN_TABLE
    from s2a_bench.store.requests import samples_table
    from s2a_bench.store.run import read_run

    model, rng = read_run(MODEL), np.random.default_rng(requests)
    cells = [*model.manifest["configuration"]["pipelines"]][:CELLS]
    manifest = json.loads((MODEL / "manifest.json").read_text(encoding="utf-8"))
    manifest["configuration"]["engine"]["answer"] = "tokens"
    manifest["configuration"]["pipelines"] = {name: manifest["configuration"]["pipelines"][name] for name in cells}
    manifest["model"].pop("answer")
    manifest["warnings"] = []
    blocks = requests // len(cells)
    with ExitStack() as files:
        folder.mkdir(parents=True)
        samples = _Files(folder, samples_table(model.stages), files, csv=csv)
        tokens = _Files(folder, TOKEN_TABLE, files, csv=csv)
        for first in range(0, blocks, BLOCKS_AT_ONCE):
            block = np.arange(first, min(first + BLOCKS_AT_ONCE, blocks))
            position = rng.permuted(np.tile(np.arange(len(cells)), (len(block), 1)), axis=1).T
            drawn = [_rows(model, name, block, position[place], rng) for place, name in enumerate(cells)]
            order = np.lexsort((position.ravel(), np.tile(block, len(cells))))
            samples.write([of_samples for of_samples, _ in drawn], order)
            tokens.write([of_tokens for _, of_tokens in drawn], (order[:, None] * TOKENS + np.arange(TOKENS)).ravel())
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2), encoding="utf-8")  # last: the run is whole


def _rows(
    model: StoredRun, name: str, block: np.ndarray, position: np.ndarray, rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the columns of a cell's samples, and of their tokens, drawn around its last sample in ``model``."""
    import numpy as np

    like = model.samples[model.samples["cell"] == name].iloc[-1]
    (_, first_ns), *marks = json.loads(like["marks"])
    count, stages = len(block), [stage for stage, _ in marks]
    steps_ns = np.diff([first_ns, *(stamp for _, stamp in marks)])
    taken_ns = np.rint(steps_ns * rng.lognormal(0, SPREAD, (count, len(steps_ns)))).astype("int64")
    begin_ns = first_ns + (block * CELLS + position) * PERIOD_NS
    marks_ns = begin_ns[:, None] + np.cumsum(taken_ns, axis=1)
    spent_ns = {stage: taken_ns[:, [each == stage for each in stages]].sum(axis=1) for stage in stages}
    e2e_ns, residual_ns = marks_ns[:, -1] - begin_ns, spent_ns.pop("")
    without_ns = e2e_ns - spent_ns["inference"]

    facts = json.loads(like["facts"])
    drawn = np.array([*facts.values()]) * rng.lognormal(0, SPREAD, (count, len(facts)))
    facts_text = "{" + ",".join(f'"{key}":%{"d" if isinstance(facts[key], int) else "r"}' for key in facts) + "}"
    marks_text = "[" + ",".join(f'["{stage}",%d]' for stage in ("", *stages)) + "]"
    request_id = [f"{name}-{number}" for number in block.tolist()]

    engine_ns = marks_ns[:, [stages.index("inference")]] + np.cumsum(rng.lognormal(11, SPREAD, (count, TOKENS)), axis=1)
    delay_ns = taken_ns[:, [-1]] * rng.lognormal(0, SPREAD, (count, TOKENS))
    client_ns = np.maximum.accumulate(np.rint(engine_ns + delay_ns).astype("int64"), axis=1)
    code = model.origins.of_row(name)
    constant = ("cell", "pipeline", "variant", "payload", "connection", "engine", "mode", "size")
    samples = {
        **{key: [str(like[key])] * count for key in constant},
        "block": block,
        "position": position,
        "warmup": block < WARMUP_BLOCKS,
        "request_id": request_id,
        "frame_index": block,
        "error": [""] * count,
        "marks": [marks_text % tuple(row) for row in np.column_stack((begin_ns, marks_ns)).tolist()],
        "n_tokens": np.full(count, TOKENS),
        "last_token_ns": client_ns[:, -1],
        "frame_age_ns": e2e_ns - taken_ns[:, -1],
        "facts": [facts_text % tuple(row) for row in drawn.tolist()],
        "launch": np.zeros(count, "int64"),
        **{f"{stage}_ns": values for stage, values in spent_ns.items()},
        "e2e_ns": e2e_ns,
        "e2e_without_inference_ns": without_ns,
        "e2e_without_model_ns": without_ns,
        "ttft_ns": e2e_ns - spent_ns["capture"],
        "residual_ns": residual_ns,
        "residual_share": residual_ns / without_ns,
        "provenance": [code] * count,
    }
    tokens = {
        "request_id": np.repeat(request_id, TOKENS),
        "cell": [name] * count * TOKENS,
        "index": np.tile(np.arange(TOKENS), count),
        "token_id": np.full(count * TOKENS, -1),
        "text": [*WORDS] * count,
        "engine_ns": np.rint(engine_ns).astype("int64").ravel(),
        "client_ns": client_ns.ravel(),
        "provenance": [code] * count * TOKENS,
    }
    return samples, tokens


class _Files:
    """The Parquet file of a table, and its CSV, which grow by the rows of a few blocks."""

    def __init__(self, folder: Path, table: Table[Any], files: ExitStack, *, csv: bool) -> None:
        import pyarrow as pa
        from pyarrow.csv import CSVWriter, WriteOptions
        from pyarrow.parquet import ParquetWriter

        self._schema = pa.schema(
            [(name, pa.type_for_alias({"json": "string"}.get(kind, kind))) for name, kind in table.columns.items()]
        )
        self._writers = [files.enter_context(ParquetWriter(folder / f"{table.name}.parquet", self._schema))]
        if csv:
            file = files.enter_context((folder / f"{table.name}.csv").open("wb"))
            file.write((",".join(table.columns) + "\n").encode())
            options = WriteOptions(include_header=False, quoting_style="needed")
            self._writers.append(files.enter_context(CSVWriter(file, self._schema, write_options=options)))

    def write(self, cells: Sequence[dict[str, Any]], order: np.ndarray) -> None:
        """Append the rows of all cells in the given order."""
        import pyarrow as pa

        whole = pa.concat_tables(map(self._table, cells)).take(order)
        for writer in self._writers:
            writer.write_table(whole)

    def _table(self, columns: dict[str, Any]) -> Any:
        """Return the rows of a cell; an absent column is null."""
        import pyarrow as pa

        nulls = pa.nulls(len(columns["cell"]))
        arrays = [pa.array(columns.get(each.name, nulls), each.type) for each in self._schema]
        return pa.table(arrays, schema=self._schema)


def cost_of(arguments: Sequence[str]) -> Cost:
    """Run a process of this Python to its end; raises CalledProcessError if it fails."""
    command, began = [sys.executable, "-c", *arguments], perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:  # noqa: S603
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return Cost(perf_counter() - began, used.ru_utime, used.ru_maxrss * 1024 / 1e6)


def measure(run: Path, page: Path) -> Iterator[tuple[str, Cost]]:
    """Yield what each way to look at a run costs, by its name."""
    yield "--help", cost_of([MAIN, "--help"])
    yield "load", cost_of([LOAD, str(run)])
    yield "run.samples", cost_of([f"{LOAD}; run.samples", str(run)])
    yield "report", cost_of([MAIN, "report", str(run), "--output", str(page)])
    yield "compare", cost_of([MAIN, "compare", str(run), str(run)])


def main() -> None:
    """Print a line for each run and way to look at it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, nargs="+", default=REQUESTS, help="of each run")
    parser.add_argument("--folder", type=Path, help="where the runs are, or are written; default: a temporary one")
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        print(f"{'requests':>9} {'wall s':>8} {'user s':>8} {'peak MB':>8}")
        for requests in arguments.requests:
            run = folder / f"latency-{requests}"
            if not (run / "manifest.json").exists():
                # in a process of its own, whose memory is not inherited by those that are measured
                writer = get_context("spawn").Process(
                    target=write_run, args=(run, requests), kwargs={"csv": requests <= CSV_UP_TO}
                )
                writer.start()
                writer.join()
            for name, cost in measure(run, Path(temporary) / "page.html"):
                print(f"{requests:9} {cost.wall_s:8.1f} {cost.user_s:8.1f} {cost.peak_mb:8.0f}  {name}", flush=True)


if __name__ == "__main__":
    main()
