"""The CCRB run on a model's tokens: one real request about the rendered scene, then the roll-outs in virtual time.

Open loop: the request is at t = 0, and the road does not change the answer. The model's text is parsed only for the
arrival times of its skills; the ego drives the scenario's set-points.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.act.events import Event, PlanFeed, SkillArrived
from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.run import Prepared, complete, drive_point
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.plan import FeedPlan
from s2a_bench.harness.rounds import RunningLaunch, Task, run_requests
from s2a_bench.harness.timelines.link import ModelLink, PlanPrompt, prepare_requests
from s2a_bench.harness.timelines.policies import prepare as prepare_policies
from s2a_bench.plan import Parser
from s2a_bench.policy import Plans, PlanShape
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.scenario import Simulator
from s2a_bench.scenario.ccrb.drive import place
from s2a_bench.store.requests import SKILLS

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.progress import Progress


def run_ccrb_live(config: CcrbConfig, world: Simulator, output: Path, progress: Progress) -> Path:
    """Request one plan and drive it under every policy; raises S2AError. The folder keeps the requests so far."""

    def view(feed: FeedPlan) -> FrameSource:
        camera = world.camera(*feed.size)
        place(world, config.scenario.cars)
        return Stamped(camera, feed.nonce)

    plan, (ask,) = prepare_requests(config.request, progress)
    live = {**config.request.to_manifest(), "source": f"camera of {world.name}"}
    plan = plan.with_manifest(
        configuration={**config.to_manifest(), "live": live},
        follower_law=config.scenario.follower_law,
        seeds={"sampling": plan.request.seed, "nonce": plan.feed.nonce},
    )
    tables = (ROLLOUTS, TRAJECTORIES, SKILLS)
    task = Task("ccrb", drive=partial(_drive, config, ask, world), tables=tables, source=view)
    return run_requests(task, plan, output, progress)


def _drive(config: CcrbConfig, ask: PlanPrompt, world: Simulator, launch: RunningLaunch) -> None:
    progress = launch.progress
    progress.expect(launch.plan.blocks.warmup + 1)
    link = ModelLink(config.request, launch, f"{world.name} simulator")
    prior = link.warm_up(ask)
    progress.stage(f"one plan over {link.cell.name}")
    ready = _request_plan(config, ask, link, prior)
    progress.advance()
    progress.stage("driving the operating point")
    drive_point(config, ready, world, launch.writer)


def _request_plan(config: CcrbConfig, ask: PlanPrompt, link: ModelLink, prior: GapPrior | None) -> Prepared:
    """Request the plan and apply the policies to its arrivals; raises TransportError for an incomplete plan."""
    events: list[Event] = []
    feed = PlanFeed(Parser(ask.format), events.append)
    measured = link.request(ask, 0, feed)
    link.require_answers()
    requested_ns = feed.requested_ns or 0
    came_ns = [event.at_ns for event in events if isinstance(event, SkillArrived)][: ask.n_skills]
    if len(came_ns) < ask.n_skills:
        raise TransportError(
            f"{link.cell.name}: {len(came_ns)} of {ask.n_skills} skills arrived; {link.writer.path / 'tokens.csv'} has "
            "what the model wrote"
        )
    link.learn_rate(feed.token_ns)
    request_id = measured.sample.request_id
    link.writer.update(request={"request_id": request_id, "requested_ns": requested_ns})
    times = config.scenario.durations
    setting = replace(link.setting(ask), t_nom_s=times.nominal_s)

    def column(at_ns: list[int]) -> Floats:
        return (np.array(at_ns, dtype=np.float64)[:, np.newaxis] - requested_ns) / 1e9

    rows = np.ones((ask.n_skills, 1))
    shape = PlanShape(ask.n_skills, ask.tokens_per_skill, times)
    plans = Plans(
        column(came_ns),
        times.nominal_s * rows,
        times.least_s * rows,
        times.most_s * rows,
        column(feed.token_ns),
        shape,
    )
    policies = prepare_policies(config.request, shape, prior).policies()
    return complete(config, setting, request_id, plans, policies)
