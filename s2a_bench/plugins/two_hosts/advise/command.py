"""`s2a-bench advise`: a transport for a link."""

from __future__ import annotations

import statistics
from dataclasses import replace
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_json, print_line, print_table
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.requests import cells_of
from s2a_bench.inference import STAND_IN
from s2a_bench.plugins.two_hosts.advise import CHECKED, LONGEST_PAUSE_S, AdviseConfig
from s2a_bench.store.run import read_run
from s2a_bench.transport import ACTIONS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2a_bench.plugins.two_hosts.advise.prediction import Advice
    from s2a_bench.progress import Progress


def _advise(config: AdviseConfig, *, json_: Json = False) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.plugins.two_hosts.advise.prediction import advice_json, advice_table, advise, sentence

    found, profile, origin = advise(config)
    if config.measure:
        with RunProgress("samples") as progress:
            times_ms = _measured_ms(config, found[:CHECKED], progress)
        found[:CHECKED] = [replace(each, measured_ms=ms) for each, ms in zip(found, times_ms, strict=False)]
    if json_:
        print_json(advice_json(found, config, profile, origin))
        return
    print_table(table := advice_table(found, config, profile, origin))
    for line in (*table.notes, sentence(found, config, profile)):
        print_line(line)


def _measured_ms(config: AdviseConfig, found: Sequence[Advice], progress: Progress) -> list[float]:
    """Return the medians of pipelines' e2e without inference on the emulated link, in ms, of one run at the rate."""
    from s2a_bench.experiments.latency.view.against_bytes import METRIC

    latency = EXPERIMENTS["latency"]
    requests = resolve_name(latency.config)(
        transports=tuple(each.name for each in found),
        link=config.link,
        engine={"name": STAND_IN, "answer": ACTIONS},
        size=config.size,
        cameras=config.cameras,
        state=14,
        requests=30,
        think_s=min(LONGEST_PAUSE_S, max(0.0, config.period_ms - max(each.e2e_ms for each in found)) / 1e3),
    )
    cells = {cell.name: cell for cell in cells_of(read_run(latency.run_with(requests, config.output, progress)))}
    return [float(statistics.median(cells[each.name].values_ms(METRIC))) for each in requests.pipelines]


advise = command(_advise, AdviseConfig)
