"""`s2a-bench advise`, a transport for a link: the options and the command."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json, print_line, print_table
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.inference import STAND_IN
from s2a_bench.options import Options, Size, option
from s2a_bench.plugins.two_hosts.profiles import published
from s2a_bench.store.run import read_run
from s2a_bench.transport import ACTIONS

if TYPE_CHECKING:
    from s2a_bench.plugins.two_hosts.advise.prediction import Advice
    from s2a_bench.progress import Progress

REFERENCE: Final = Path(__file__).resolve().parents[4] / "results" / "reference" / "transports"
CHECKED: Final = 2
"""Pipelines that `check` measures."""
LONGEST_PAUSE_S: Final = 5.0
"""The longest pause between its requests: TCP's window has fallen to its initial size by then."""
MB: Final = 1e6
_DURATION: Final = re.compile(r"(\d+\.?\d*)(ms|s)")


def _duration(text: str) -> str:
    if text and not _DURATION.fullmatch(text):
        raise ValueError(f"'{text}' should be a time, as 100ms or 0.5s")
    return text


class AdviseConfig(Options):
    """The link, and the requests that should go over it."""

    link: str = option(
        ..., f"{', '.join(published())}, a FILE, or rate=UP/DOWN,delay=MS, as in latency", names=published, first=True
    )
    rate: float = option(0.0, "requests a second that the link should carry; 0: without a pause", ge=0, le=10_000)
    deadline: Annotated[str, AfterValidator(_duration)] = option(
        "", "longest end to end without inference, as 100ms or 0.5s [default: none]"
    )
    size: Size = option((640, 480), "WIDTHxHEIGHT of the pictures [default: 640x480]")
    cameras: int = option(1, "pictures a request", ge=1, le=16)
    runs: list[Path] = option(
        (REFERENCE,),
        "folders of a `sweep transports` or of its runs, of the machine that is asked about "
        "[default: the reference run of the project, of another machine]",
    )
    measure: bool = option(
        False, f"also measure the first {CHECKED} on the emulated link, beside the prediction", flag="check"
    )
    output: Path = option(Path("results"), "folder for the runs of `check`")

    @property
    def deadline_ms(self) -> float:
        """The deadline, infinite for none."""
        duration = _DURATION.fullmatch(self.deadline)
        return float(duration[1]) * (1 if duration[2] == "ms" else 1e3) if duration else math.inf

    @property
    def period_ms(self) -> float:
        """Return the time from one request to the next; 0 for one after another."""
        return 1e3 / self.rate if self.rate else 0.0

    @property
    def pixels_mb(self) -> float:
        return self.size[0] * self.size[1] * 3 * self.cameras / MB


def _advise(config: AdviseConfig, *, json_: Json = False) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.plugins.two_hosts.advise.prediction import advice_json, advice_table, advise, sentence

    advices, profile, origin = advise(config)
    if config.measure:
        with RunProgress("samples") as progress:
            times_ms = _measured_ms(config, advices[:CHECKED], progress)
        advices[:CHECKED] = [replace(each, measured_ms=ms) for each, ms in zip(advices, times_ms, strict=False)]
    if json_:
        print_json(advice_json(advices, config, profile, origin))
        return
    print_table(table := advice_table(advices, config, profile, origin))
    for line in (*table.notes, sentence(advices, config, profile)):
        print_line(line)


def _measured_ms(config: AdviseConfig, advices: Sequence[Advice], progress: Progress) -> list[float]:
    """Return the medians of pipelines' e2e without inference on the emulated link, in ms, of one run at the rate."""
    from s2a_bench.experiments.latency.view.against_bytes import METRIC
    from s2a_bench.experiments.requests import cells_of

    latency = EXPERIMENTS["latency"]
    requests = resolve_name(latency.config)(
        transports=tuple(each.name for each in advices),
        link=config.link,
        engine={"name": STAND_IN, "answer": ACTIONS},
        size=config.size,
        cameras=config.cameras,
        state=14,
        requests=30,
        think_s=min(LONGEST_PAUSE_S, max(0.0, config.period_ms - max(each.e2e_ms for each in advices)) / 1e3),
    )
    cells = {cell.name: cell for cell in cells_of(read_run(latency.run_with(requests, config.output, progress)))}
    return [float(statistics.median(cells[each.name].values(METRIC))) for each in requests.pipelines]


advise = command(_advise, AdviseConfig)
