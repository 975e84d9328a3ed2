"""The CCRB run on a model's tokens, about the ego's view; the ego drives the scenario's set-points.

The model's text is parsed only for the arrival times of its skills. Open loop: one request at t = 0, then the roll-outs
in virtual time. Closed loop: a request a policy, executed as it arrives, while the world runs on the clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.act.events import (
    AbortRequested,
    Event,
    LiveInbox,
    PlanFeed,
    Requested,
    SkillArrived,
    TokenArrived,
)
from s2a_bench.act.record import Record, observed
from s2a_bench.clock import SystemClock, now_ns, quick_switching
from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.loop import ClosedLoop
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.run import Prepared, complete, drive_point, keep_loop
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.plan import FeedPlan
from s2a_bench.harness.rounds import RunningLaunch, Task, run_requests
from s2a_bench.harness.session import Measured
from s2a_bench.harness.timelines.link import ModelLink, PlanPrompt, prepare_requests
from s2a_bench.harness.timelines.policies import prepare as prepare_policies
from s2a_bench.plan import Parser
from s2a_bench.policy import PlanShape, Policy
from s2a_bench.scenario import Simulator
from s2a_bench.scenario.ccrb.drive import place
from s2a_bench.store.requests import SKILLS

if TYPE_CHECKING:
    from s2a_bench.progress import Progress

STEP_S: Final = 0.02
"""Step on the clock of a world without physics of its own."""
CRUISE_S: Final = 0.5
"""Time on the road before the request of a closed loop."""


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
    link = ModelLink(config.request, launch, f"{world.name} simulator")
    shape = PlanShape(ask.n_skills, ask.tokens_per_skill, config.scenario.durations)
    plans = len(config.timeline.chosen) if config.closed_loop else 1
    progress.expect(launch.plan.blocks.warmup + plans)
    policies = prepare_policies(config.request, shape, link.warm_up(ask)).policies()
    if not config.closed_loop:
        progress.stage(f"one plan over {link.cell.name}")
        ready = _request_plan(config, ask, link, shape, policies)
        progress.advance()
        progress.stage("driving the operating point")
        drive_point(config, ready, world, launch.writer)
        return
    for name, policy in policies.items():
        progress.stage(f"{name}, over {link.cell.name}")
        _run_loop(config, ask, link, shape, name, policy, world)
        progress.advance()


def _request_plan(
    config: CcrbConfig, ask: PlanPrompt, link: ModelLink, shape: PlanShape, policies: Mapping[str, Policy]
) -> Prepared:
    """Request the plan and apply the policies to its arrivals; raises TransportError for an incomplete plan."""
    record = Record("")
    calls = iter(config.scenario.calls)

    def put(event: Event) -> None:
        match event:
            case Requested(at_ns):
                record.requested_ns = at_ns
            case TokenArrived(at_ns):
                record.token_ns.append(at_ns)
            case SkillArrived(at_ns, call):
                record.arrivals.append((at_ns, next(calls, call)))

    measured = link.request(ask, 0, PlanFeed(Parser(ask.format), put))
    return _arrived(config, ask, link, shape, record, measured, policies)


def _run_loop(
    config: CcrbConfig,
    ask: PlanPrompt,
    link: ModelLink,
    shape: PlanShape,
    name: str,
    policy: Policy,
    world: Simulator,
) -> None:
    """Let the cars drive, request a plan, and execute it as it arrives; raises an error that ends the run."""
    clock = SystemClock()
    loop = ClosedLoop(config.scenario, world, LiveInbox(), clock)
    feed = PlanFeed(Parser(ask.format), loop.put)
    with quick_switching(), ThreadPoolExecutor(1, "world") as pool:
        running = pool.submit(loop.run, policy, shape, config.request.timeout_s)
        try:
            clock.sleep_until_ns(clock.now_ns() + round(CRUISE_S * 1e9))
            measured = link.request(ask, 0, feed)
        except BaseException:
            loop.put(AbortRequested(now_ns(), "the run was ended"))
            running.result()  # the world's own error, if it has one, says more
            raise
        looped = running.result()
    ready = _arrived(config, ask, link, shape, looped.record, measured, {name: policy})
    keep_loop(config, ready, world, name, looped, link.writer)


def _arrived(
    config: CcrbConfig,
    ask: PlanPrompt,
    link: ModelLink,
    shape: PlanShape,
    record: Record,
    measured: Measured,
    policies: Mapping[str, Policy],
) -> Prepared:
    """Schedule a received plan; raises TransportError if it is incomplete, or was not executed to its end."""
    link.require_answers()
    plans = observed(record, shape)
    if plans is None or record.why:
        why = record.why or f"{len(record.arrivals)} of {ask.n_skills} skills arrived"
        written = link.writer.path / "tokens.csv"
        raise TransportError(f"{link.cell.name}: {why}; {written} has what the model wrote")
    link.learn_rate(record.token_ns)
    request_id, requested_ns = measured.sample.request_id, record.requested_ns
    link.writer.update(requests={request_id: requested_ns})
    setting = replace(link.setting(ask), t_nom_s=config.scenario.durations.nominal_s)
    return complete(config, setting, request_id, plans, policies)
