"""The CCRB run on a model's tokens, about the ego's view; the ego drives the scenario's set-points.

The model's text is parsed only for the arrival times of its skills. Open loop: one request at t = 0, then the roll-outs
in virtual time. Closed loop: a request a policy, executed as it arrives, while the world runs on the clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.act.events import AbortRequested, Event, LiveInbox, PlanFeed, SkillArrived
from s2a_bench.act.record import Record, observed
from s2a_bench.act.ros import STRING
from s2a_bench.clock import SystemClock, now_ns, quick_switching
from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.loop import ClosedLoop, Looped
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.run import Prepared, complete, drive_point, keep_loop
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.plan import FeedPlan
from s2a_bench.harness.recording import RunRecorder
from s2a_bench.harness.rounds import RunningLaunch, Task, run_requests
from s2a_bench.harness.session import Measured
from s2a_bench.harness.timelines.link import ModelLink, PlanPrompt, prepare_requests
from s2a_bench.harness.timelines.policies import prepare as prepare_policies
from s2a_bench.plan import Parser
from s2a_bench.policy import PlanShape, Policy
from s2a_bench.ros import messages as ros
from s2a_bench.scenario import ROLES, Simulator
from s2a_bench.scenario.ccrb.drive import place
from s2a_bench.store.requests import SKILLS
from s2a_bench.types import Frame

if TYPE_CHECKING:
    from s2a_bench.progress import Progress

STEP_S: Final = 0.02
"""Step on the clock of a world without physics of its own."""
PICTURE: Final = (320, 240)
ODOMETRY: Final = "nav_msgs/msg/Odometry"
CRUISE_S: Final = 0.5
"""Time on the road before the request of a closed loop."""


def run_ccrb_live(config: CcrbConfig, world: Simulator, output: Path, progress: Progress) -> Path:
    """Request one plan and drive it under every policy; raises S2AError. The folder keeps the requests so far."""
    if config.closed_loop and not world.real:
        world.step_s = STEP_S

    def view(feed: FeedPlan) -> FrameSource:
        camera = world.camera(*feed.size)
        place(world, config.scenario.cars)
        return Stamped(camera, feed.nonce)

    plan, (ask,) = prepare_requests(config.request, progress)
    live = {**config.request.to_manifest(), "source": f"camera of {world.name}"}
    plan = replace(plan, record=config.plan_request.record).with_manifest(
        configuration={**config.to_manifest(), "live": live},
        follower_law=config.scenario.follower_law,
        seeds={"sampling": plan.request.seed, "nonce": plan.feed.nonce},
    )
    tables = (ROLLOUTS, TRAJECTORIES, SKILLS)
    task = Task("ccrb", drive=partial(_drive, config, ask, world), tables=tables, source=view)
    return run_requests(task, plan, output, progress)


def _drive(config: CcrbConfig, ask: PlanPrompt, world: Simulator, launch: RunningLaunch) -> None:
    progress = launch.progress
    shape = PlanShape(ask.n_skills, ask.tokens_per_skill, config.scenario.durations)
    view = world.camera(*PICTURE) if launch.recorder and config.closed_loop else None
    requests = _Requests(config, ask, ModelLink(config.request, launch, f"{world.name} simulator"), shape, world, view)
    progress.expect(launch.plan.blocks.warmup + (len(config.timeline.chosen) if config.closed_loop else 1))
    policies = prepare_policies(config.request, shape, requests.link.warm_up(ask)).policies()
    runs = [{name: policy} for name, policy in policies.items()] if config.closed_loop else [policies]
    for each in runs:
        progress.stage(f"{', '.join(each)}: a plan over {requests.link.cell.name}")
        (requests.closed_loop if config.closed_loop else requests.roll_out)(each)
        progress.advance()


@dataclass(frozen=True, slots=True)
class _Requests:
    """Requests for plans of one shape, and what is driven on them; every error ends the run."""

    config: CcrbConfig
    ask: PlanPrompt
    link: ModelLink
    shape: PlanShape
    world: Simulator
    view: FrameSource | None

    def roll_out(self, policies: Mapping[str, Policy]) -> None:
        """Request a plan, and drive it in virtual time."""
        events: list[Event] = []
        feed = PlanFeed(Parser(self.ask.format), events.append)
        measured = self.link.request(self.ask, 0, feed)
        arrivals_ns = [event.at_ns for event in events if isinstance(event, SkillArrived)]
        arrivals = list(zip(arrivals_ns, self.config.scenario.calls, strict=False))
        record = Record("", feed.requested_ns, feed.token_ns, arrivals)
        drive_point(self.config, self._arrived(record, measured, policies), self.world, self.link.writer)

    def closed_loop(self, policies: Mapping[str, Policy]) -> None:
        """Let the cars drive, request a plan, and execute it under the one policy as it arrives."""
        clock, ((name, policy),) = SystemClock(), policies.items()
        loop = ClosedLoop(self.config.scenario, self.world, LiveInbox(), clock, self.view)
        feed = PlanFeed(Parser(self.ask.format), loop.put)
        with quick_switching(), ThreadPoolExecutor(1, "world") as pool:
            running = pool.submit(loop.run, policy, self.shape, self.config.request.timeout_s)
            try:
                clock.sleep_until_ns(clock.now_ns() + round(CRUISE_S * 1e9))
                measured = self.link.request(self.ask, 0, feed)
                looped = running.result()
            except BaseException:
                loop.put(AbortRequested(now_ns(), "the run was ended"))
                running.result()  # the world's own error, if it has one, says more
                raise
        if self.link.launch.recorder:
            _record(self.link.launch.recorder, name, loop.pictures, looped)
        ready = self._arrived(looped.record, measured, policies)
        keep_loop(self.config, ready, self.world, name, looped, self.link.writer)

    def _arrived(self, record: Record, measured: Measured, policies: Mapping[str, Policy]) -> Prepared:
        """Schedule a received plan; raises TransportError if it is incomplete, or was not executed to its end."""
        link = self.link
        link.require_answers()
        plans = observed(record, self.shape)
        if plans is None or record.why:
            why = record.why or f"{len(record.arrivals)} of {self.ask.n_skills} skills arrived"
            written = link.writer.path / "tokens.csv"
            raise TransportError(f"{link.cell.name}: {why}; {written} has what the model wrote")
        link.learn_rate(record.token_ns)
        link.writer.update(requests={measured.sample.request_id: record.requested_ns})
        setting = replace(link.setting(self.ask), t_nom_s=self.config.scenario.durations.nominal_s)
        return complete(self.config, setting, measured.sample.request_id, plans, policies)


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
