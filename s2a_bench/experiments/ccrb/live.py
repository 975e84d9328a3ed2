"""The CCRB run on a model's tokens: one real request about the rendered scene, then the roll-outs in virtual time.

Open loop: the request is at t = 0, and nothing that happens on the road changes the answer. What the model writes is
parsed, as arrivals are those of parsed skills; the set-points that the ego drives are the scenario's.
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.plans import Prepared, complete
from s2a_bench.experiments.ccrb.point import drive_point
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.timeline.live.asks import Ask
from s2a_bench.experiments.timeline.live.asks import prepare as prepare_policies
from s2a_bench.experiments.timeline.live.link import Link, word
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.machine import environment
from s2a_bench.machine.tuning import keep_large_blocks, limit_threads
from s2a_bench.plan import Parser
from s2a_bench.policy import Plans, PlanShape, Timing
from s2a_bench.policy.conformal import TOLERANCE_S
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import stalls
from s2a_bench.runtime.events import Event, SkillCame
from s2a_bench.runtime.feed import PlanFeed
from s2a_bench.scenario import simulator
from s2a_bench.scenario.ccrb.source import RoadSource
from s2a_bench.store.requests import TOKENS, samples_table
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.progress import Progress


def run_ccrb_live(config: CcrbConfig, output: Path, progress: Progress) -> Path:
    """Ask for one plan and drive it under every policy; raises S2AError.

    Whatever happens, the requests so far are in the folder.
    """
    limit_threads()
    keep_large_blocks()
    with ExitStack() as stack:
        world = stack.enter_context(closing(simulator(config.simulator, **config.world)))
        live = config.request
        requests, (ask,) = word(live, progress)
        source = RoadSource(config.scenario.cars, requests.width, requests.height, fps=requests.fps)
        manifest = {
            "configuration": {**config.to_manifest(), "live": {**live.to_manifest(), "source": source.name}},
            "follower_law": config.scenario.follower_law,
            "stages": requests.stages,
            "facts": requests.facts,
            "environment": environment.collect(requests.packages),
            "seeds": {"sampling": requests.seed, "nonce": requests.nonce},
        }
        tables = (ROLLOUTS, TRAJECTORIES, SKILLS, samples_table(requests.stages), TOKENS)
        writer = stack.enter_context(RunWriter.create(output, "ccrb", manifest, tables))
        progress.opened(writer.path)
        progress.expect(requests.warmup + 1)
        link = Link(live, requests, writer, progress)
        try:
            link.connect(stack, source, f"{world.name} simulator")
            prior = link.warm_up(ask)
            progress.stage(f"one plan over {link.cell.name}")
            ready = _hear(config, ask, link, prior)
            progress.advance()
            progress.stage("driving the operating point")
            drive_point(config, ready, world, writer)
        finally:
            writer.update(warnings=[warning.to_manifest() for warning in link.warnings])
        return writer.path


def _hear(config: CcrbConfig, ask: Ask, link: Link, prior: GapPrior | None) -> Prepared:
    """Make the request, and let the policies have its arrivals; raises TransportError where the plan is not whole."""
    events: list[Event] = []
    feed = PlanFeed(Parser(ask.format), events.append)
    measured = link.ask(ask, 0, feed)
    link.require_answers()
    requested_ns = feed.requested_ns or 0
    came_ns = [event.at_ns for event in events if isinstance(event, SkillCame)][: ask.n_skills]
    if len(came_ns) < ask.n_skills:
        raise TransportError(
            f"{link.cell.name}: {len(came_ns)} of {ask.n_skills} skills came; {link.writer.path / 'tokens.csv'} has "
            "what the model wrote"
        )
    link.saw(feed.token_ns)
    request_id = measured.sample.request_id
    link.writer.update(request={"request_id": request_id, "requested_ns": requested_ns})
    times = config.scenario.durations
    setting = replace(link.setting(ask), t_nom_s=times.nominal_s)

    def column(at_ns: list[int]) -> Floats:
        return (np.array(at_ns, dtype=np.float64)[:, np.newaxis] - requested_ns) / 1e9

    rows = np.ones((ask.n_skills, 1))
    expected = Timing(times.nominal_s, times.least_s, times.most_s)
    shape = PlanShape(ask.n_skills, ask.tokens_per_skill, expected)
    plans = Plans(
        column(came_ns),
        times.nominal_s * rows,
        times.least_s * rows,
        times.most_s * rows,
        column(feed.token_ns),
        shape,
    )
    following = prepare_policies(config.request, shape, prior)
    ready = complete(config, setting, request_id, plans, following.policies())
    gaps_s = {name: stalls(schedule) for name, schedule in ready.schedules.items()}
    following.learn_plan(plans, {name: bool((gap_s > TOLERANCE_S).any()) for name, gap_s in gaps_s.items()})
    return ready
