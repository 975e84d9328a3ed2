"""A timeline run: computed in virtual time, played on the clock, or live."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.experiments.timeline.config import TimelineConfig

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


def run_timeline(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    """Run all timelines and return the run folder; raises S2AError for what a user can mend."""
    if config.live:
        from s2a_bench.experiments.timeline.live.run import run_live as run
    elif config.real_time:
        from s2a_bench.experiments.timeline.real_time import run_real_time as run
    else:
        from s2a_bench.experiments.timeline.virtual import run_virtual as run
    return run(config, output, progress)
