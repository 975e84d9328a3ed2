"""Live timelines: a model writes plans, over a real transport, and every policy executes them as they arrive.

Tokens, parsing and execution are real. With ``--pace`` the server holds the tokens back to a rate: then the rate is
set, and said to be; nothing is emulated unless the engine is the replay of a profile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

from s2a_bench.bench import environment
from s2a_bench.bench.execution import Scene, SideBySide, View, jitter_facts, keep, quick_switching
from s2a_bench.bench.feed import RequestFeed
from s2a_bench.bench.live_asks import Ask, asks_of, prepare, prior_of
from s2a_bench.bench.live_config import LiveConfig
from s2a_bench.bench.plan import plan_cells
from s2a_bench.bench.servers import ServerSet
from s2a_bench.bench.session import Measured, Place, Session
from s2a_bench.bench.timeline_rows import Setting
from s2a_bench.bench.tuning import keep_large_blocks, limit_threads
from s2a_bench.bench.warnings import Doubt, before_run
from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError, TransportError, UsageError
from s2a_bench.frames import open_source
from s2a_bench.inference.models import resolve
from s2a_bench.plan import Parser
from s2a_bench.policy import Policy
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.runtime import Robot, find_robot
from s2a_bench.runtime.events import StreamBroke
from s2a_bench.runtime.feed import PlanFeed
from s2a_bench.runtime.record import Record
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import SAMPLES, SKILLS, TIMELINES, TOKENS
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, open_client
from s2a_bench.types import Request, Token

MODE = "live"
LATE = 1.05
"""An answer that takes so many times what the pace allows was not paced, but slow."""


class Tap:
    """A client whose tokens are also told to whoever executes the plan."""

    def __init__(self, client: Client) -> None:
        """Stand before ``client``."""
        self._client = client
        self.camera = client.camera
        self.plan: PlanFeed | None = None
        """Who is told; nobody during warm-up."""

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Pass tokens on, and tell of each before that; time counts from the start of the capture."""
        plan = self.plan
        if plan is None:
            yield from self._client.request(request, trace)
            return
        plan.requested(trace.marks[0][1])
        try:
            for token in self._client.request(request, trace):
                plan.token(token.text, now_ns())
                yield token
        except S2AError as error:
            plan.broke(f"{type(error).__name__}: {error}", now_ns())
            raise
        plan.ended(now_ns())

    def describe(self) -> dict[str, str]:
        """Say what the client says."""
        return self._client.describe()

    def close(self) -> None:
        """Close the client."""
        self._client.close()


def run_live(config: LiveConfig, output: Path, view: View) -> Path:
    """Ask for plans, execute them, and return the run folder; raises S2AError for what a user can mend.

    Whatever happens, the timelines so far are in the folder. KeyboardInterrupt passes through, after the robots hold.
    """
    config.check()
    limit_threads()
    if config.requests.dds_tuning == "tuned":
        keep_large_blocks()
    with ExitStack() as stack:
        requests = config.requests
        if not config.paper_format:
            view.stage("reading the model's headers" if requests.engine.model else "the tiny dummy model")
            model, mmproj = resolve(requests.engine)
            requests = replace(requests, engine=replace(requests.engine, model=model, mmproj=mmproj))
        asks = asks_of(config, requests.engine.model)
        requests = replace(requests, max_tokens=max(ask.max_tokens for ask in asks))
        source = open_source(requests.source, requests.width, requests.height, fps=requests.fps, seed=requests.seed)
        stack.callback(source.close)
        manifest = {
            "configuration": {**config.to_manifest(), "engine": requests.to_manifest()["engine"]},
            "environment": environment.collect(),
            "seeds": {"sampling": requests.seed, "source": requests.seed},
        }
        tables = (TIMELINES, SKILLS, SAMPLES, TOKENS)
        writer = stack.enter_context(RunWriter.create(output, "timeline", manifest, tables))
        view.opened(writer.path)
        stack.enter_context(quick_switching())
        run = _Live(replace(config, requests=requests), writer, view)
        try:
            run.connect(stack, RequestFeed(source, preencoded=requests.payload == "jpeg-preencoded"))
            run.everything(asks)
        finally:
            run.conclude()
        return writer.path


@dataclass
class _Live:
    """One run under way."""

    config: LiveConfig
    writer: RunWriter
    view: View
    records: list[Record] = field(default_factory=list)
    doubts: list[Doubt] = field(default_factory=list)
    blocks: Iterator[int] = field(default_factory=count)
    facts: dict[str, Any] = field(default_factory=dict)
    """What the engine says about itself."""
    rate: float | None = None
    """Tokens/s: set, or as first seen."""
    answers: int = 0
    """Plans that came as they should."""

    def connect(self, stack: ExitStack, feed: RequestFeed) -> None:
        """Open the robots, start the server or find the one that runs, and open a client."""
        requests = self.config.requests
        build = find_robot(self.config.robot)  # first, as a model may take long to load
        self.robots: list[Robot] = [
            stack.enter_context(closing(build(self.config.skill_set))) for _ in self.config.policies
        ]
        (transport,) = requests.transports
        uses_dds = transport == "ros"
        self.doubts += before_run(requests.width, requests.height, uses_dds=uses_dds)
        self.view.stage(f"starting the {transport} server")
        self.servers = ServerSet(requests, stack, self.writer.path)
        facts = self.servers.start()
        self.facts = self.servers.model(facts)
        (self.cell,) = plan_cells(requests, self.servers.addresses)
        with self.servers.death_explained(transport):
            client = open_client(self.cell.route, self.servers.alive(transport))
        self.tap = stack.enter_context(closing(Tap(client)))
        self.feed = feed
        self.rate = requests.engine.pace or None
        self.writer.update(
            servers=facts,
            model=self.facts,
            live={
                "transport": self.cell.name,
                "engine": self.facts.get("engine", "unknown"),
                "emulated": bool(self.facts.get("emulated", False)),
                **({"dummy": self.facts["dummy"]} if "dummy" in self.facts else {}),
                **({"paced_tokens_per_s": self.rate} if self.rate else {}),
                "grammar": self.config.constrained,
                "skills": self.config.skill_set.name,
                "robot": self.config.robot,
            },
        )

    def everything(self, asks: Sequence[Ask]) -> None:
        """Warm up, then ask for all plans."""
        warmups = self.config.requests.warmup
        self.view.expect(warmups + len(asks) * self.config.plans)
        arrivals_ns = []
        for _ in range(warmups):
            self.view.stage("warming up")
            measured = self._ask(asks[0], 0, None)
            arrivals_ns.append([token.client_ns for token in measured.tokens])
            self.view.advance()
        prior = prior_of(arrivals_ns, self.rate)
        if prior is not None:
            self.rate = self.rate or 1 / prior.mean_s
            about = {"mean_s": prior.mean_s, "plan_cv": prior.plan_cv, "token_cv": prior.token_cv}
            self.writer.update(prior={**about, "warmups": warmups})
        for ask in asks:
            for plan in range(self.config.plans):
                self._execute(ask, plan, prior)
                self.view.advance()
        if not self.answers:
            raise TransportError(
                f"no request of {self.cell.name} succeeded; {self.writer.path / 'samples.csv'} says why"
            )

    def _execute(self, ask: Ask, plan: int, prior: GapPrior | None) -> None:
        """Ask for one plan and let every policy execute it as it arrives."""
        policies = [prepare(name, prior) for name in self.config.policies]
        rate = self.rate
        span_s = ask.n_skills * (ask.tokens_per_skill / rate if rate else 0.0) + ask.n_skills * ask.t_nom_s
        self.view.stage(f"{self.cell.name}, L = {ask.tokens_per_skill}: about {span_s:.0f} s")
        timeout_s = self.config.requests.timeout_s
        side_by_side = SideBySide(policies, ask.shape, ask.skills.gap, self.robots, timeout_s)
        feed = PlanFeed(Parser(ask.format), side_by_side.tell)
        title = f"live {self.cell.name}, L = {ask.tokens_per_skill}{self._remarks()}"
        request_id = ""
        try:
            with side_by_side, self.view.show(Scene(title, side_by_side.records, ask.n_skills, span_s)):
                try:
                    request_id = self._ask(ask, plan, feed).sample.request_id
                except S2AError as error:  # the run ends, but not in the middle of a skill
                    side_by_side.tell(StreamBroke(now_ns(), "stream-error", f"{type(error).__name__}: {error}"))
                    side_by_side.finish()
                    raise
                side_by_side.finish()
        finally:  # what an interruption leaves is kept too
            self.records += side_by_side.records
            self._keep(ask, plan, request_id, policies, side_by_side.records)

    def _keep(self, ask: Ask, plan: int, request_id: str, policies: Sequence[Policy], records: list[Record]) -> None:
        """Keep what the policies made of one plan."""
        token_ns = max((record.token_ns for record in records), key=len)
        if self.rate is None and len(token_ns) > 1:
            self.rate = (len(token_ns) - 1) / (token_ns[-1] - token_ns[0]) * 1e9
        self._doubt_pace(token_ns)
        setting = self._setting(ask, self.rate or 0.0)
        self.doubts += keep(self.writer, setting, plan, request_id, policies, records)

    def _doubt_pace(self, token_ns: Sequence[int]) -> None:
        """Say where the model was slower than the pace."""
        pace = self.config.requests.engine.pace
        span_s = (token_ns[-1] - token_ns[0]) / 1e9 if token_ns else 0.0
        if pace and span_s > LATE * (len(token_ns) - 1) / pace:
            came = (len(token_ns) - 1) / span_s
            what = f"{came:.3g} tokens/s came, not the {pace:g} of --pace: the model is slower"
            self.doubts.append(Doubt("pace-missed", what, "stop what else runs, try --threads 1, or a lower --pace"))

    def _ask(self, ask: Ask, plan: int, feed: PlanFeed | None) -> Measured:
        """Make one request and keep its rows; raises what ends the run."""
        requests = self.config.requests
        asked = replace(
            requests,
            prompt=ask.prompt,
            grammar=ask.grammar,
            max_tokens=ask.max_tokens,
            seed=requests.seed + plan,
        )
        self.tap.plan = feed
        session = Session(self.cell, self.tap, self.feed, asked)
        measured = session.measure(Place(next(self.blocks), 0, warmup=feed is None))
        if feed is not None:  # the executors' times: the harness sees a token some microseconds later
            tokens = [replace(row, client_ns=at_ns) for row, at_ns in zip(measured.tokens, feed.token_ns, strict=False)]
            measured = replace(measured, tokens=tokens)
            self.answers += not measured.sample.error
        self.writer.sample(measured.sample)
        self.writer.tokens(measured.tokens)
        transport = self.cell.route.transport
        self.servers.raise_if_dead(transport, suspect=measured.fatal is not None)
        if isinstance(measured.fatal, UsageError) and "grammar" in str(measured.fatal):
            raise UsageError(f"{measured.fatal} (here: --no-grammar)") from measured.fatal
        if measured.fatal is not None:
            raise measured.fatal
        return measured

    def _setting(self, ask: Ask, rate: float) -> Setting:
        return Setting(
            board="",
            title=f"live {self.cell.name}",
            tokens_per_s=float(f"{rate:.4g}"),
            prompt_s=None,
            tokens_per_skill=ask.tokens_per_skill,
            n_skills=ask.n_skills,
            t_nom_s=ask.t_nom_s,
            mode=MODE,
            emulated=bool(self.facts.get("emulated", False)),
        )

    def _remarks(self) -> str:
        """Say what is not as it seems."""
        pace = self.config.requests.engine.pace
        paced = f", paced to {pace:g} tokens/s" if pace else ""
        dummy = ", dummy weights" if self.facts.get("dummy") else ""
        return f"{paced}{dummy}{' (EMULATED)' if self.facts.get('emulated') else ''}"

    def conclude(self) -> None:
        """Write what is said of the whole run."""
        self.writer.update(
            start_jitter=jitter_facts(self.records), warnings=[doubt.to_manifest() for doubt in self.doubts]
        )
