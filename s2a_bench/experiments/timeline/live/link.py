"""A model to ask for plans: its server, a client, warm-ups, and requests whose tokens are told as they come."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError, TransportError, UsageError
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.live.asks import Ask, asks_of, prior_of
from s2a_bench.experiments.timeline.live.config import in_paper_format, requests_of
from s2a_bench.experiments.timeline.to_rows import Setting
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped, new_nonce
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.flash_attention import decided
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.harness.servers import ServerSet
from s2a_bench.harness.session import Measured, Place, Session
from s2a_bench.harness.warnings import before_run, odd_facts
from s2a_bench.inference import need_engine
from s2a_bench.inference.models import resolve
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.runtime.feed import PlanFeed
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.run import RunWriter
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, open_client
from s2a_bench.types import Piece, Request

MODE = "live"
LATE = 1.05
"""An answer that takes so many times what the pace allows was not paced, but slow."""


class Tee:
    """A client whose tokens are also told to whoever executes the plan."""

    def __init__(self, client: Client) -> None:
        """Stand before ``client``."""
        self._client = client
        self.camera = client.camera
        self.plan: PlanFeed | None = None
        """Who is told; nobody during warm-up."""

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
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
        """Return what the client says."""
        return self._client.describe()

    def close(self) -> None:
        """Close the client."""
        self._client.close()


def word(config: TimelineConfig, progress: Progress) -> tuple[RequestsConfig, list[Ask]]:
    """Find the model's files and word what it is asked, with the room that it needs; raises S2AError."""
    requests = requests_of(config)
    if not in_paper_format(config):
        need_engine("llama")
        progress.stage("reading the model's headers" if requests.engine.model else "the tiny dummy model")
        model, mmproj = resolve(requests.engine)
        requests = requests.but(engine=requests.engine.but(model=model, mmproj=mmproj))
    asks = asks_of(config, requests.engine.model)
    longest = max(ask.max_tokens for ask in asks)
    return requests.but(max_tokens=longest, nonce=requests.nonce or new_nonce()), asks


@dataclass
class Link:
    """The way to one model, for one run."""

    config: TimelineConfig
    requests: RequestsConfig
    """As `word` returned them."""
    writer: RunWriter
    progress: Progress
    warnings: list[RunWarning] = field(default_factory=list)
    blocks: Iterator[int] = field(default_factory=count)
    facts: dict[str, Any] = field(default_factory=dict)
    """What the engine says about itself."""
    rate: float | None = None
    """Tokens/s: set, or as first seen."""
    origin: Provenance = field(default_factory=Provenance)
    """Who answers, as far as it was told."""
    answers: int = 0
    """Plans that came as they should."""
    odd: set[str] = field(default_factory=set)
    """What the server said that can be no fact."""

    def connect(self, stack: ExitStack, source: FrameSource, robot: str) -> None:
        """Start the server or find the one that runs, and open a client; ``robot`` is who will act, for the record."""
        engine, told = decided(self.requests.engine, self.progress.stage, self.writer.path / "flash-attention.log")
        self.writer.update(**told)
        self.requests = requests = self.requests.but(engine=engine)
        (self.cell,) = requests.pipelines
        self.warnings += before_run(requests)
        self.servers = ServerSet(requests, stack, self.writer.path)
        if self.servers.count:
            self.progress.stage(f"starting the {self.cell.transport.name} server")
        facts = self.servers.start()
        self.facts = self.servers.model(facts)
        self.origin = self.servers.origin(self.cell)
        with self.servers.death_explained(self.cell):
            client = open_client(self.servers.wiring(self.cell), self.servers.alive(self.cell))
        self.tee = stack.enter_context(closing(Tee(client)))
        self.feed = RequestFeed(Stamped(source, requests.nonce), preencoded=self.cell.payload == "jpeg-preencoded")
        self.rate = requests.engine.pace
        self.writer.update(
            servers=facts,
            model=self.facts,
            provenance=Origins(self.origin).to_manifest(),
            live={
                "transport": self.cell.name,
                **self._told(),
                **({"paced_tokens_per_s": self.rate} if self.rate else {}),
                "grammar": not self.config.no_grammar,
                "skills": self.config.skill_set.name,
                "robot": robot,
            },
        )

    @property
    def emulated(self) -> bool:
        """Return whether the engine is the replay of a profile."""
        return self.origin.emulated

    def _told(self) -> dict[str, Any]:
        """Return what the manifest's ``live`` says of who answers; ``dummy`` where it is known."""
        dummy = {"dummy": True, "real": False}.get(self.origin.weights)
        return {
            "engine": self.origin.engine,
            "emulated": self.emulated,
            **({} if dummy is None else {"dummy": dummy}),
        }

    def warm_up(self, ask: Ask) -> GapPrior | None:
        """Ask as often as the configuration wants, and return what policies learn from that."""
        warmups = self.requests.warmup
        arrivals_ns = []
        for _ in range(warmups):
            self.progress.stage("warming up")
            measured = self.ask(ask, 0, None)
            arrivals_ns.append([token.client_ns for token in measured.tokens])
            self.progress.advance()
        prior = prior_of(arrivals_ns, self.rate)
        if prior is not None:
            self.rate = self.rate or 1 / prior.mean_s
            about = {"mean_s": prior.mean_s, "plan_cv": prior.plan_cv, "token_cv": prior.token_cv}
            self.writer.update(prior={**about, "warmups": warmups})
        return prior

    def ask(self, ask: Ask, plan: int, feed: PlanFeed | None) -> Measured:
        """Make one request and keep its rows; raises what ends the run."""
        requests = self.requests
        asked = requests.but(
            prompt=ask.prompt,
            grammar=ask.grammar,
            max_tokens=ask.max_tokens,
            seed=requests.seed + plan,
        )
        self.tee.plan = feed
        session = Session(self.cell, self.tee, self.feed, asked, origin=self.origin)
        measured = session.measure(Place(next(self.blocks), 0, warmup=feed is None))
        if session.origin != self.origin:
            self.origin = session.origin
            self.writer.update(provenance=Origins(self.origin).to_manifest(), live=self._told())
        if feed is not None:  # the executors' times: the harness sees a token some microseconds later
            tokens = [replace(row, client_ns=at_ns) for row, at_ns in zip(measured.tokens, feed.token_ns, strict=False)]
            measured = replace(measured, tokens=tokens)
            self.answers += not measured.sample.error
        self.warnings += odd_facts({self.cell.name: new} if (new := measured.odd - self.odd) else {})
        self.odd |= measured.odd
        self.writer.sample(measured.sample)
        self.writer.tokens(measured.tokens)
        if isinstance(measured.fatal, KeyboardInterrupt):
            raise measured.fatal
        self.servers.raise_if_dead(self.cell, suspect=measured.fatal is not None)
        if isinstance(measured.fatal, UsageError) and "grammar" in str(measured.fatal):
            raise UsageError(f"{measured.fatal} (here: `no_grammar`)") from measured.fatal
        if measured.fatal is not None:
            raise measured.fatal
        return measured

    def setting(self, ask: Ask) -> Setting:
        """Return the setting of what was asked, at the rate that was seen."""
        return Setting(
            board="",
            title=f"live {self.cell.name}",
            tokens_per_s=float(f"{self.rate or 0.0:.4g}"),
            prompt_s=None,
            tokens_per_skill=ask.tokens_per_skill,
            n_skills=ask.n_skills,
            t_nom_s=ask.t_nom_s,
            mode=MODE,
            emulated=self.emulated,
        )

    def saw(self, token_ns: Sequence[int]) -> None:
        """Learn the rate from an answer if nobody set it, and warn where the model was slower."""
        if len(token_ns) < 2:  # noqa: PLR2004 - no gap
            return
        came = (len(token_ns) - 1) / (token_ns[-1] - token_ns[0]) * 1e9
        self.rate = self.rate or came
        pace = self.requests.engine.pace
        if pace and came * LATE < pace:
            what = f"{came:.3g} tokens/s came, not the {pace:g} of --pace: the model is slower"
            self.warnings.append(
                RunWarning("pace-missed", what, "stop what else runs, try --threads 1, or a lower --pace")
            )

    def require_answers(self) -> None:
        """Raise TransportError where no plan came as it should."""
        if not self.answers:
            raise TransportError(
                f"no request of {self.cell.name} succeeded; {self.writer.path / 'samples.csv'} says why"
            )
