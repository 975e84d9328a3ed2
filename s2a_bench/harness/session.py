"""Measure one request: capture, send, collect tokens, and turn the trace into rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import InitVar, asdict, dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise, repeat
from typing import Any, TypeAlias

from s2a_bench.act.events import PlanFeed
from s2a_bench.clock import clock_id, now_ns
from s2a_bench.errors import EngineError, RequestFailed, S2AError, ServerDied, SourceError, TransportError, UsageError
from s2a_bench.facts import (
    CACHE_N,
    CAMERA_FRAMES,
    CAMERA_STAMP_AGE_MS,
    FRAMES_LOST,
    FRAMES_PUBLISHED,
    PAYLOAD_BYTES,
    PROMPT_MS,
    PROMPT_N,
)
from s2a_bench.frames import open_source
from s2a_bench.frames.convert import to_rgb
from s2a_bench.harness.feed import Feed, RequestFeed, StreamedFrame, StreamFeed
from s2a_bench.harness.pixels import RGB_ENGINE, fingerprint, together
from s2a_bench.harness.plan import RequestPlan
from s2a_bench.harness.recording import RunRecorder
from s2a_bench.inference import swing
from s2a_bench.machine.resources.sampler import ResourceSampler
from s2a_bench.provenance import NOT_SENT, UNKNOWN, Provenance
from s2a_bench.secrets import struck_pieces
from s2a_bench.store.requests import FrameRow, SampleRow, TokenRow
from s2a_bench.trace import STAGES, Trace
from s2a_bench.transport import LOSSLESS, Client
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.serving import CLOCK_PROMPT
from s2a_bench.transport.surroundings import Joined
from s2a_bench.types import Frame, Piece, Request, Token

FATAL = (ServerDied, SourceError, UsageError, EngineError)
"""Errors after which the next request cannot succeed either."""

Seen: TypeAlias = tuple[Piece, int]
"""A piece, and its time of arrival in ns."""

INTERRUPTED = "Interrupted: the run was ended during this request"


@dataclass(frozen=True, slots=True)
class Place:
    block: int
    position: int
    warmup: bool
    launch: int = 0


@dataclass(frozen=True, slots=True)
class Measured:
    """The rows of one request; ``fingerprint`` identifies its picture.

    ``fatal`` ends the run, as a KeyboardInterrupt during the request. ``retry_after_s`` is the wait that a server
    demands when it refuses, or that failures in a row of one that may be starting call for.
    """

    sample: SampleRow
    tokens: list[TokenRow]
    fingerprint: int
    fatal: S2AError | KeyboardInterrupt | None = None
    retry_after_s: float = 0.0
    odd: frozenset[str] = frozenset()
    """Names of the server's facts with impossible values."""


@dataclass(frozen=True, slots=True)
class RequestContext:
    """The settings of one request that differ from the run's, and the receivers of its pieces as they arrive."""

    state: tuple[float, ...] | None = None
    """The robot's; None: a synthetic state."""
    on_piece: Callable[[Piece, int], None] | None = None
    """Called on the measuring thread with each piece and its time of arrival in ns."""
    plan: PlanFeed | None = None
    """Receives the answer as it arrives, from the start of the capture."""
    request: RequestPlan | None = None
    """None: the run's."""


PLAIN = RequestContext()
UNKNOWN_ORIGIN = Provenance()
SMALL = (16, 16)
LONGEST_PAUSE_S = 4.0
"""The longest pause after failures in a row of a server that may be starting; the first, after two, is 1 s."""
KEPT_FRAMES = 90
"""Frames that a later answer may name: three seconds at 30 Hz."""


@dataclass(eq=False)
class Session:
    """The client side of one cell, with an open client."""

    cell: Pipeline
    client: Client
    feed: Feed
    request: RequestPlan
    recorder: RunRecorder | None = None
    sampler: ResourceSampler = field(default_factory=lambda: ResourceSampler({}, 1))
    origin: Provenance = UNKNOWN_ORIGIN
    """It is replaced by the provenance that an answer carries."""
    clocks: InitVar[dict[str, Any] | None] = None
    """The state of other hosts' clocks that sessions share; see `Surroundings.clock` for None."""

    def __post_init__(self, clocks: dict[str, Any] | None) -> None:
        others = (each.clock(self._exchange, clocks) for each in self.request.surroundings)
        self._clock = next(filter(None, others), None)
        self._frames: dict[int, StreamedFrame] = {}
        self._pictures = 0
        """Number of pictures of the last request."""
        self._absent, self.answered = 0, False
        """Failures in a row of a server that may be starting; whether it has answered."""
        self.busy = False
        """Whether a request is under way, so that no other thread may use the client."""
        self.prompt_n = 0
        """Tokens of the last prompt, pictures included; 0 if no server reports it."""

    def measure(self, place: Place, context: RequestContext = PLAIN) -> Measured:
        """Make one request; a failure becomes a row with its error, and `Measured.fatal` if it ends the run."""
        self.busy = True
        try:
            if self._clock:
                self._clock.refresh()
            return self._measure(place, context)
        finally:
            self.busy = False

    def _measure(self, place: Place, context: RequestContext) -> Measured:
        self.feed.get_ready()
        request_id = f"{self.cell.name}-{place.block}"
        seen: list[Seen] = []
        trace = Trace()
        error, retry_after_s = "", 0.0
        fatal: S2AError | KeyboardInterrupt | None = None
        plan, state = context.request or self.request, context.state
        if state is None:  # another one in each block, float32
            state = tuple(swing(1, plan.state, place.block)[0].tolist()) if plan.state else ()
        started_ns = now_ns()
        self.sampler.edge()
        frames = self.feed.capture(trace)
        sent = frames if self.origin.pictures != NOT_SENT else ()
        request = Request(request_id, plan.prompt, sent, plan.max_pieces, plan.grammar, plan.seed, state=state)
        try:
            for piece_at in self._pieces(request, trace, context):
                seen.append(piece_at)  # noqa: PERF402 - what came before an error is kept
        except S2AError as failure:
            error = f"{type(failure).__name__}: {failure}"
            fatal, retry_after_s = self._failed(failure)
        except KeyboardInterrupt as interrupt:
            error, fatal = INTERRUPTED, interrupt
        self.sampler.edge()
        self._pictures = len(frames)
        # of the whole answer: a secret may span pieces
        texts = iter(struck_pieces([piece.text for piece, _ in seen if isinstance(piece, Token)]))
        seen = [(replace(piece, text=next(texts)) if isinstance(piece, Token) else piece, at) for piece, at in seen]
        trace.facts.update(self.sampler.window(started_ns, now_ns()))
        if not error and not seen:
            error = "RequestFailed: the answer was empty"
        if self.recorder is not None:
            if plan.mode == "request":  # in stream mode the camera records its frames
                for frame in frames:
                    self.recorder.frame(frame)
            self.recorder.answer(self.cell.name, request, trace.marks[0][1], seen, error)
            self.recorder.flush()
        rows = self._rows(place, request_id, frames, trace, seen, error)
        if not rows.sample.error:
            self._absent, self.answered = 0, True
        return replace(rows, fatal=fatal or rows.fatal, retry_after_s=retry_after_s)

    def _failed(self, failure: S2AError) -> tuple[S2AError | None, float]:
        """Return the failure if it ends the run, and how long to wait: as long as the server asks, or may take."""
        restarts = isinstance(failure, ServerDied) and self.answered and self.cell.options.external_address
        self._absent = self._absent + 1 if isinstance(failure, TransportError) and failure.starting else 0
        pause_s = min(2.0 ** (self._absent - 2), LONGEST_PAUSE_S) if self._absent > 1 else 0.0
        retry_after_s = isinstance(failure, RequestFailed) and failure.retry_after_s
        return failure if isinstance(failure, FATAL) and not restarts else None, retry_after_s or pause_s

    @cached_property
    def _small(self) -> RequestFeed:
        """The least pictures that a request can carry, as many as the last one had."""
        source = open_source("synthetic", *SMALL, fps=30, seed=0)
        return RequestFeed(source, preencoded=self.cell.preencoded, cameras=self._pictures)

    def _exchange(self, system: str) -> Trace:
        """Make a request that our server answers without its engine, with its wall clock by a ``system`` if named."""
        trace, plan = Trace(), self.request
        self._small.get_ready()
        frames, kind = self._small.capture(trace), self.cell.capabilities.answer_kinds[0]
        prompt = f"{CLOCK_PROMPT}{kind} {system}".rstrip()
        list(self.client.request(Request("clock", prompt, frames, 1, state=(0.0,) * plan.state), trace))
        return trace

    def _pieces(self, request: Request, trace: Trace, context: RequestContext) -> Iterator[Seen]:
        plan = context.plan
        if plan is not None:
            plan.requested(trace.marks[0][1])
        try:
            for piece in self.client.request(request, trace):
                at_ns = now_ns()
                if context.on_piece is not None:
                    context.on_piece(piece, at_ns)
                if plan is not None:
                    plan.token(piece.text, at_ns)
                yield piece, at_ns
        except S2AError as error:
            if plan is not None:
                plan.broke(f"{type(error).__name__}: {error}", now_ns())
            raise
        if plan is not None:
            plan.ended(now_ns())

    def _rows(
        self, place: Place, request_id: str, frames: Sequence[Frame], trace: Trace, seen: list[Seen], error: str
    ) -> Measured:
        facts = trace.facts
        origin = Provenance.from_dict(trace.provenance or (trace.remote.provenance if trace.remote else {}))
        if trace.remote and self.origin.link in {"real", UNKNOWN}:  # behind a tunnel, loopback is another machine
            self.origin = replace(self.origin, link="real" if trace.remote.clock == clock_id() else UNKNOWN)
        if origin.known:
            self.origin = replace(origin, link=self.origin.link, link_profile=self.origin.link_profile)
        other_host = trace.remote is not None and trace.remote.clock != clock_id()
        joined, apart = None, None
        if self._clock and other_host and seen and not error:
            try:
                joined = self._clock.join(trace, seen[-1][1])
            except TransportError as failure:
                apart, error = failure, f"{type(failure).__name__}: {failure}"
        streamed = self._streamed(trace, request_id, joined)
        if streamed:
            index, captured_ns, picture = streamed.index, streamed.captured_ns, streamed.index
        elif frames:
            index, captured_ns = frames[0].index, frames[0].stamp_ns
            picture = together(fingerprint(frame.data) for frame in frames)
        else:
            index, captured_ns, picture = -1, -1, place.block
        if isinstance(self.feed, StreamFeed) and streamed is None:
            error = error or "RequestFailed: the server knew no frame of this camera"
        rgb_source = together(fingerprint(to_rgb(frame)) for frame in frames) if frames else None
        rgb_engine = _whole(facts.pop(RGB_ENGINE, None))  # it becomes a column
        error = error or self._doubt(trace, rgb_source, rgb_engine)
        started_ns = inference_start_ns(trace)
        age_ns = started_ns - captured_ns if started_ns is not None and captured_ns >= 0 else None
        if joined or other_host:
            facts.pop(CAMERA_STAMP_AGE_MS, None)  # the difference of two hosts' wall clocks
        self.prompt_n = _whole(facts.get(PROMPT_N)) or self.prompt_n
        sample = SampleRow(
            cell=self.cell.name,
            pipeline=self.cell.transport.name,
            variant=self.cell.variant,
            payload=self.cell.payload,
            connection=getattr(self.cell.options, "connection", ""),
            engine=self.origin.engine,
            mode=self.request.mode,
            size=self.request.size,
            **asdict(place),
            request_id=request_id,
            frame_index=index,
            error=error,
            marks=trace.chain(),
            n_tokens=len(seen),
            last_token_ns=seen[-1][1] if seen else None,
            frame_age_ns=None if joined else age_ns,
            cache_n=_whole(facts.get(CACHE_N)),
            prompt_n=_whole(facts.get(PROMPT_N)),
            server_prompt_ms=facts.get(PROMPT_MS),
            rgb_source=rgb_source,
            rgb_engine=rgb_engine,
            payload_bytes=_whole(facts.get(PAYLOAD_BYTES)),
            facts=facts,
            clock_error_ns=joined.error_ns if joined else None,
            frame_age_lo_ns=max(0, age_ns - joined.error_ns) if joined and age_ns is not None else None,
            frame_age_hi_ns=age_ns + joined.error_ns if joined and age_ns is not None else None,
        )
        engine_ns = trace.remote.token_ns if trace.remote and trace.remote.clock == clock_id() else []
        tokens = [
            TokenRow(
                request_id=request_id,
                cell=self.cell.name,
                index=token.index,
                token_id=token.id,
                text=token.text,
                engine_ns=None if joined else left_ns,
                client_ns=client_ns,
                engine_lo_ns=left_ns - joined.early_ns if joined and left_ns else None,
                engine_hi_ns=min(left_ns + joined.late_ns, client_ns) if joined and left_ns else None,
            )
            # A server that reports no times, or fewer than tokens, leaves null.
            for (token, client_ns), left_ns in zip(seen, chain(engine_ns, repeat(None)), strict=False)
        ]
        return Measured(sample, tokens, picture, apart, odd=frozenset(trace.odd))

    def _doubt(self, trace: Trace, rgb_source: int | None, rgb_engine: int | None) -> str:
        if unknown := {stage for stage, _ in trace.chain() if stage} - self.request.stages.keys():
            return f"TransportError: {self.cell.transport.name} does not declare the stage {', '.join(sorted(unknown))}"
        if self.cell.payload in LOSSLESS and None not in {rgb_source, rgb_engine} and rgb_source != rgb_engine:
            return "TransportError: the engine saw other pixels than the camera gave, though nothing should be lost"
        return ""

    def _streamed(self, trace: Trace, request_id: str, joined: Joined | None) -> StreamedFrame | None:
        """Find the camera frame that the answer is about, and complete its marks with the server's."""
        if not isinstance(self.feed, StreamFeed):
            return None
        self._frames.update((frame.key, frame) for frame in self.feed.camera.drain())
        used = self.feed.last
        if self.feed.sink is not None:
            used = self._frames.get(trace.remote.frame_stamp_ns) if trace.remote else None
            if used is not None and trace.remote is not None:
                # Once: the frame may be the newest for several answers.
                if not used.used_by and trace.remote.clock == clock_id():
                    used.marks = [*used.marks, *trace.remote.frame_marks]
                    used.clock_error_ns = max(joined.early_ns, joined.late_ns) if joined else None
                if CAMERA_FRAMES in trace.facts:
                    trace.facts[FRAMES_PUBLISHED] = used.sequence
                    trace.facts[FRAMES_LOST] = used.sequence - trace.facts[CAMERA_FRAMES]
        if used is not None:
            used.used_by = request_id
        return used

    def frames(self, keep: int = KEPT_FRAMES) -> list[FrameRow]:
        """Return the rows of the camera's frames so far, except the newest ``keep``, which an answer may name."""
        rows = []
        while len(self._frames) > keep:
            frame = self._frames.pop(next(iter(self._frames)))
            used_by, error_ns = frame.used_by, frame.clock_error_ns
            rows.append(FrameRow(self.cell.name, frame.index, frame.intended_ns, frame.marks, used_by, error_ns))
        return rows


def inference_start_ns(trace: Trace) -> int | None:
    """Return when the engine got the request: the mark before the first of `inference`'s group."""
    steps = pairwise(trace.chain())
    return next((before_ns for (_, before_ns), (stage, _) in steps if STAGES.get(stage) == "inference"), None)


def _whole(value: float | None) -> int | None:
    return None if value is None or not math.isfinite(value) else int(value)
