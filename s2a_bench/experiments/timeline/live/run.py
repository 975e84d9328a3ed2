"""Live timelines: a model writes plans, over a real transport, and every policy executes them as they arrive.

Tokens, parsing and execution are real. With ``--pace`` the server holds the tokens back to a rate: then the rate is
set, and said to be; nothing is emulated unless the engine is the replay of a profile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.execution import SideBySide, jitter_facts, keep, quick_switching
from s2a_bench.experiments.timeline.following import Following
from s2a_bench.experiments.timeline.live.asks import Ask, prepare
from s2a_bench.experiments.timeline.live.link import Link, word
from s2a_bench.experiments.timeline.rows import SKILLS, TIMELINES
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.frames import FrameSource, open_source
from s2a_bench.machine import environment
from s2a_bench.machine.tuning import keep_large_blocks, limit_threads
from s2a_bench.plan import Parser
from s2a_bench.policy import Policy
from s2a_bench.progress import Progress, watching
from s2a_bench.runtime import ROBOTS, Robot
from s2a_bench.runtime.events import StreamBroke
from s2a_bench.runtime.feed import PlanFeed
from s2a_bench.runtime.record import Record
from s2a_bench.store.requests import TOKENS, samples_table
from s2a_bench.store.run import RunWriter


def run_live(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    """Ask for plans, execute them, and return the run folder; raises S2AError for what a user can mend.

    Whatever happens, the timelines so far are in the folder. KeyboardInterrupt passes through, after the robots hold.
    """
    limit_threads()
    keep_large_blocks()
    with ExitStack() as stack:
        requests, asks = word(config, progress)
        source = open_source(requests.source, requests.width, requests.height, fps=requests.fps, seed=requests.seed)
        stack.callback(source.close)
        manifest = {
            "configuration": {**config.to_manifest(), "engine": requests.to_manifest()["engine"]},
            "stages": requests.stages,
            "facts": requests.facts,
            "environment": environment.collect(requests.packages),
            "seeds": {"sampling": requests.seed, "source": requests.seed, "nonce": requests.nonce},
        }
        tables = (TIMELINES, SKILLS, samples_table(requests.stages), TOKENS)
        writer = stack.enter_context(RunWriter.create(output, "timeline", manifest, tables))
        progress.opened(writer.path)
        stack.enter_context(quick_switching())
        run = _Live(Link(config, requests, writer, progress), progress)
        try:
            run.connect(stack, source)
            run.everything(asks)
        finally:
            run.conclude()
        return writer.path


@dataclass
class _Live:
    """One run under way."""

    link: Link
    progress: Progress
    records: list[Record] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Have at hand what is asked for."""
        self.config = self.link.config

    def connect(self, stack: ExitStack, source: FrameSource) -> None:
        """Open the robots, then the way to the model."""
        build = ROBOTS[self.config.robot]  # first, as a model may take long to load
        self.robots: list[Robot] = [
            stack.enter_context(closing(build(self.config.skill_set))) for _ in self.config.chosen
        ]
        self.link.connect(stack, source, self.config.robot)

    def everything(self, asks: Sequence[Ask]) -> None:
        """Warm up, then ask for all plans."""
        self.progress.expect(self.config.warmup + len(asks) * self.config.plans_a_cell)
        prior = self.link.warm_up(asks[0])
        for ask in asks:
            following = prepare(self.config, ask.shape, prior)
            for plan in range(self.config.plans_a_cell):
                self._execute(ask, plan, following)
                self.progress.advance()
        self.link.require_answers()

    def _execute(self, ask: Ask, plan: int, following: Following) -> None:
        """Ask for one plan and let every policy execute it as it arrives."""
        policies = following.policies()
        rate = self.link.rate
        span_s = ask.n_skills * (ask.tokens_per_skill / rate if rate else 0.0) + ask.n_skills * ask.t_nom_s
        self.progress.stage(f"{self.link.cell.name}, L = {ask.tokens_per_skill}: about {span_s:.0f} s")
        timeout_s = self.config.timeout_s
        side_by_side = SideBySide(policies, ask.shape, ask.skills.gap, self.robots, timeout_s)
        feed = PlanFeed(Parser(ask.format), side_by_side.tell)
        title = f"live {self.link.cell.name}, L = {ask.tokens_per_skill}{self._remarks()}"
        request_id = ""
        try:
            with side_by_side, watching(self.progress, Scene(title, side_by_side.records, ask.n_skills, span_s)):
                try:
                    request_id = self.link.ask(ask, plan, feed).sample.request_id
                except S2AError as error:  # the run ends, but not in the middle of a skill
                    side_by_side.tell(StreamBroke(now_ns(), "stream-error", f"{type(error).__name__}: {error}"))
                    side_by_side.finish()
                    raise
                side_by_side.finish()
        finally:  # what an interruption leaves is kept too
            self.records += side_by_side.records
            self._keep(ask, plan, request_id, policies, side_by_side.records)
        following.learn(side_by_side.records)

    def _keep(
        self, ask: Ask, plan: int, request_id: str, policies: Mapping[str, Policy], records: list[Record]
    ) -> None:
        """Keep what the policies made of one plan."""
        token_ns = max((record.token_ns for record in records), key=len)
        self.link.saw(token_ns)
        setting = self.link.setting(ask)
        self.link.warnings += keep(self.link.writer, setting, plan, request_id, policies, records)

    def _remarks(self) -> str:
        """Return what is not as it seems."""
        pace = self.config.engine.pace
        paced = f", paced to {pace:g} tokens/s" if pace else ""
        dummy = ", dummy weights" if self.link.facts.get("dummy") else ""
        return f"{paced}{dummy}{' (EMULATED)' if self.link.emulated else ''}"

    def conclude(self) -> None:
        """Write what is said of the whole run."""
        self.link.writer.update(
            start_jitter=jitter_facts(self.records), warnings=[warning.to_manifest() for warning in self.link.warnings]
        )
