"""Studies of the policies: cells of drawn plans, one after another or on several cores, each with its own seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.experiments.study.rows import STUDIES as TABLE
from s2a_bench.experiments.study.rows import StudyRow
from s2a_bench.policy.conformal import CONFIDENCE, PLANS, check, coarse, upper_bound

if TYPE_CHECKING:
    from s2a_bench.progress import Progress
    from s2a_bench.store.manifest import RunWarning

Cell: TypeAlias = Callable[[], Sequence[StudyRow]]
"""Independent work of a study: a partial of a module's function, so that another process can run it."""


@dataclass(frozen=True, slots=True)
class StudyConfig:
    """What may be chosen of a study."""

    seed: int = 0
    plans: int | None = None
    """Plans a cell, besides those for calibration; None: the study's own number."""
    calibration_plans: int = 400
    epsilon: float = 0.01
    jobs: int = 1
    recording: tuple[float, ...] = ()
    """Recorded gaps in their order, as one more family of the frontier."""

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError."""
        for flag, value in (("--plans", self.plans), ("--jobs", self.jobs)):
            if value is not None and value < 1:
                raise UsageError(f"{flag}: {value} should be 1 or more")
        if self.seed < 0:
            raise UsageError(f"--seed: {self.seed} should be 0 or more")
        check(self.calibration_plans, self.epsilon)

    def warnings(self) -> list[RunWarning]:
        """Return what is allowed and worth a warning."""
        from s2a_bench.store.manifest import RunWarning

        if not coarse(self.calibration_plans, self.epsilon):
            return []
        message = (
            f"{self.calibration_plans} calibration plans are few: one lambda may stall up to "
            f"{upper_bound(0, self.calibration_plans, CONFIDENCE):.1%} of its plans"
        )
        return [RunWarning("few-calibration-plans", message, f"take {PLANS} or more")]


STUDIES: dict[str, str] = {
    "targets": "s2a_bench.experiments.study.targets:cells",
    "frontier": "s2a_bench.experiments.study.jitter:cells",
    "drift": "s2a_bench.experiments.study.drift:cells",
    "misfit": "s2a_bench.experiments.study.misfit:cells",
}
"""Name of a study -> the function that lists its cells for a `StudyConfig`."""


def cells_of(name: str, config: StudyConfig) -> Sequence[Cell]:
    """List a study's cells; raises UsageError for an unknown name or a configuration that makes no sense."""
    if name not in STUDIES:
        raise UsageError(f"--study: '{name}' is none of {', '.join(STUDIES)}")
    config.check()
    cells: Sequence[Cell] = resolve_name(STUDIES[name])(config)
    return cells


def results(cells: Sequence[Cell], jobs: int = 1) -> Iterator[Sequence[StudyRow]]:
    """Yield each cell's rows in the cells' order, whatever the number of processes."""
    if jobs == 1:
        yield from (cell() for cell in cells)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_call, cells)


def run_study(name: str, config: StudyConfig, output: Path, progress: Progress) -> Path:
    """Run a study and return its run folder; rows are kept cell by cell."""
    from s2a_bench.machine.environment import collect
    from s2a_bench.store.run import RunWriter

    cells = cells_of(name, config)
    manifest = {
        "configuration": {"study": name, **asdict(config)},
        "environment": collect(),
        "seeds": {"study": config.seed},
        "warnings": [warning.to_manifest() for warning in config.warnings()],
    }
    with RunWriter.create(output, f"study-{name}", manifest, (TABLE,)) as writer:
        progress.opened(writer.path)
        progress.stage(f"study {name}")
        progress.expect(len(cells))
        for rows in results(cells, config.jobs):
            writer.append(TABLE, rows)
            progress.advance()
        return writer.path


def _call(cell: Cell) -> Sequence[StudyRow]:
    return cell()
