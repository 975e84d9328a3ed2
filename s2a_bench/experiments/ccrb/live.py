"""The CCRB run on a model's tokens, about the ego's view; the ego drives the scenario's set-points.

The model's text is parsed only for the arrival times of its skills. Open loop: one request at t = 0, then the roll-outs
in virtual time. Closed loop: a request a policy, executed as it arrives, while the world runs on the clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from s2a_bench.act.events import AbortRequested, Event, LiveInbox, PlanFeed, SkillArrived
from s2a_bench.act.record import Record, observed
from s2a_bench.act.ros import STRING
from s2a_bench.clock import SystemClock, now_ns, quick_switching
from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbLive, CcrbLiveLoop, CcrbRequested
from s2a_bench.experiments.ccrb.drives import Prepared, complete, loop_rows, point_rows
from s2a_bench.experiments.ccrb.loop import ClosedLoop, Looped
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.plan import FeedPlan, RunPlan
from s2a_bench.harness.recording import RunRecorder
from s2a_bench.harness.rounds import RunningLaunch, Task, run_requests
from s2a_bench.harness.session import Measured
from s2a_bench.harness.timelines.cases import LearningPlan
from s2a_bench.harness.timelines.link import ModelRequests, PlanPrompt, PromptPlan, plan_requests
from s2a_bench.harness.timelines.policies import prepare
from s2a_bench.plan import Parser, load_skills
from s2a_bench.policy import PlanShape, Policy
from s2a_bench.progress import Progress
from s2a_bench.ros import messages as ros
from s2a_bench.scenario import ROLES, Simulator, open_simulator, simulator_class
from s2a_bench.scenario.ccrb.drive import place
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ros import with_ego
from s2a_bench.store.requests import SKILLS
from s2a_bench.types import Frame

STEP_S: Final = 0.02
"""Step on the clock of a world without physics of its own."""
PICTURE: Final = (320, 240)
ODOMETRY: Final = "nav_msgs/msg/Odometry"
CRUISE_S: Final = 0.5
"""Time on the road before the request of a closed loop."""


@dataclass(frozen=True, slots=True)
class CcrbLivePlan:
    scenario: CcrbOptions
    requests: RunPlan
    prompt: PlanPrompt
    shape: PlanShape
    learning: LearningPlan


def resolve_live(config: CcrbRequested, progress: Progress) -> CcrbLivePlan:
    """Derive the run plan from a configuration, with the model's files; raises S2AError."""
    scenario, tokens = config.scenario, config.tokens_per_skill
    prompts = PromptPlan([load_skills(config.skill_set)], [tokens], [scenario.skills])
    requests, (prompt,) = plan_requests(config.requests.but(seed=config.seed), prompts, progress)
    source = f"camera of {simulator_class(config.simulator).name}"
    requests = requests.with_manifest(
        configuration={**config.to_manifest(), "live": {**requests.manifest["configuration"], "source": source}},
        follower_law=scenario.follower_law,
        seeds={"sampling": config.seed, "nonce": requests.feed.nonce},
    )
    shape = PlanShape(scenario.skills, tokens, scenario.durations)
    learning = LearningPlan(config.named_policies, config.seed)
    return CcrbLivePlan(scenario, requests, prompt, shape, learning)


def run_live(config: CcrbLive, output: Path, progress: Progress) -> Path:
    """Request one plan and drive it under every policy; raises S2AError. The folder keeps the requests so far."""
    with closing(open_simulator(config.simulator)) as world:
        plan = resolve_live(config, progress)
        task = _task(plan, world, partial(_roll_out, plan, world, ttc=config.ttc))
        return run_requests(task, plan.requests, output, progress)


def run_live_loop(config: CcrbLiveLoop, output: Path, progress: Progress) -> Path:
    """Request a plan a policy and execute it as it arrives; raises S2AError. The folder keeps the loops so far."""
    with closing(open_simulator(config.simulator)) as bare, closing(with_ego(bare, config.ego)) as world:
        if not world.real:
            world.step_s = STEP_S
        plan = resolve_live(config, progress)
        task = _task(plan, world, partial(_close_loops, plan, world))
        return run_requests(task, plan.requests, output, progress)


def _task(plan: CcrbLivePlan, world: Simulator, drive: Callable[[RunningLaunch], None]) -> Task:
    def view(feed: FeedPlan) -> FrameSource:
        camera = world.camera(*feed.size)
        place(world, plan.scenario.cars)
        return Stamped(camera, feed.nonce)

    return Task("ccrb", drive, tables=(ROLLOUTS, TRAJECTORIES, SKILLS), source=view)


def _roll_out(plan: CcrbLivePlan, world: Simulator, launch: RunningLaunch, *, ttc: bool) -> None:
    """Request a plan, and drive it in virtual time."""
    model = ModelRequests(launch, plan.prompt, f"{world.name} simulator")
    launch.progress.expect(launch.plan.blocks.warmup + 1)
    policies = prepare(plan.learning, plan.shape, model.warm_up()).policies()
    launch.progress.stage(f"{', '.join(policies)}: a plan over {model.cell.name}")
    events: list[Event] = []
    feed = PlanFeed(Parser(plan.prompt.format), events.append)
    measured = model.request(plan.prompt, 0, feed)
    arrivals_ns = [event.at_ns for event in events if isinstance(event, SkillArrived)]
    arrivals = list(zip(arrivals_ns, plan.scenario.calls, strict=False))
    record = Record("", feed.requested_ns, feed.token_ns, arrivals)
    ready = _arrived(plan, model, record, measured, policies)
    for table, rows in point_rows(ready.with_ttc() if ttc else ready, world):
        model.writer.append(table, rows)
    launch.progress.advance()


def _close_loops(plan: CcrbLivePlan, world: Simulator, launch: RunningLaunch) -> None:
    view = world.camera(*PICTURE) if launch.recorder else None
    model = ModelRequests(launch, plan.prompt, f"{world.name} simulator")
    launch.progress.expect(launch.plan.blocks.warmup + len(plan.learning.policies))
    model.writer.update(step_s=world.step_s)
    policies = prepare(plan.learning, plan.shape, model.warm_up()).policies()
    for name, policy in policies.items():
        launch.progress.stage(f"{name}: a plan over {model.cell.name}")
        loop = ClosedLoop(plan.scenario, world, LiveInbox(), SystemClock(), view)
        looped, measured = _close_loop(plan, model, loop, policy)
        if launch.recorder:
            _record(launch.recorder, name, loop.pictures, looped)
        ready = _arrived(plan, model, looped.record, measured, {name: policy})
        for table, rows in loop_rows(ready, world, name, looped):
            model.writer.append(table, rows)
        launch.progress.advance()


def _close_loop(plan: CcrbLivePlan, model: ModelRequests, loop: ClosedLoop, policy: Policy) -> tuple[Looped, Measured]:
    """Let the cars drive, request a plan, and execute it as it arrives."""
    clock, feed = SystemClock(), PlanFeed(Parser(plan.prompt.format), loop.put)
    with quick_switching(), ThreadPoolExecutor(1, "world") as pool:
        running = pool.submit(loop.run, policy, plan.shape, plan.requests.timeout_s)
        try:
            clock.sleep_until_ns(clock.now_ns() + round(CRUISE_S * 1e9))
            measured = model.request(plan.prompt, 0, feed)
            return running.result(), measured
        except BaseException:
            loop.put(AbortRequested(now_ns(), "the run was ended"))
            running.result()  # the world's own error, if it has one, says more
            raise


def _arrived(
    plan: CcrbLivePlan, model: ModelRequests, record: Record, measured: Measured, policies: Mapping[str, Policy]
) -> Prepared:
    """Schedule a received plan; raises TransportError if it is incomplete, or was not executed to its end."""
    plans, request_id = observed(record, plan.shape), measured.sample.request_id
    if plans is None or record.why:
        why = measured.sample.error or record.why or f"{len(record.arrivals)} of {plan.prompt.n_skills} skills arrived"
        written = model.writer.path / "tokens.csv"
        raise TransportError(f"{model.cell.name}: {why}; {written} has what the model wrote")
    model.learn_rate(record.token_ns)
    model.writer.update(requests={request_id: record.requested_ns})
    setting = replace(model.setting(plan.prompt), t_nom_s=plan.scenario.durations.nominal_s)
    return complete(plan.scenario, setting, request_id, plans, policies)


def _record(recorder: RunRecorder, policy: str, pictures: Sequence[Frame], looped: Looped) -> None:
    """Write view, skills and cars of a loop that is over, so that no step waits for it, on topics below its policy."""
    for picture in pictures:
        recorder.frame(picture, f"/{policy}/ego")
    for skill in looped.record.ran:
        for what, at_ns in (("starts", skill.start_ns), ("ends", skill.end_ns or 0)):
            recorder.note(f"/{policy}/skill", STRING, ros.message(STRING, data=f"{skill.call} {what}"), at_ns)
    path, zero_ns = looped.driven.trajectory, looped.record.requested_ns or 0
    if path is None:
        return  # the answer broke before the first step
    for step, time_s in enumerate(path.time_s):
        for car, role in enumerate(ROLES):
            message = ros.default(ODOMETRY, header=ros.header(0, "road"), child_frame_id=role)
            pose = message.pose.pose
            pose.position.x, pose.position.y = path.position_m[step, car, 0], path.lateral_m[step, car, 0]
            pose.orientation.w, message.twist.twist.linear.x = 1.0, path.speed_mps[step, car, 0]
            recorder.note(f"/{policy}/{role}/odom", ODOMETRY, message, zero_ns + round(time_s * 1e9))
    recorder.flush()
