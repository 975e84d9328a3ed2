"""Marks and stages: how the time of one request is spent.

A *mark* closes the stretch of time since the mark before it and names the stage of that stretch; the empty name means
no stage. The marks of client and server, on one clock, form one chain in order of time, so the stages and the residual
(the unnamed stretches) add up to the whole by construction.

The chain starts with an unnamed mark when capture (request mode) or the prompt (stream mode) starts, and the
first token seen by the client is the mark `return`. Everything is in integer nanoseconds of CLOCK_MONOTONIC.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, TypeAlias

from s2a_bench.clock import clock_id, now_ns

Mark: TypeAlias = tuple[str, int]
"""(stage that ends here or "", time in ns)."""

RESIDUAL = ""
"""The name of a stretch that belongs to no stage."""

RESIDUAL_LIMIT = 0.05
"""A sample whose residual is a larger share of its e2e without inference is flagged."""

GROUPS: tuple[str, ...] = (
    *("capture", "encode", "pack", "network", "ingest", "parse", "decode", "queue", "inference", "server", "return"),
)
"""The groups of stages in the order of the path."""

STAGES: dict[str, str] = {
    "capture": "capture",
    "convert": "encode",
    "resize": "encode",
    "image_encode": "encode",
    "connect": "network",
    "network": "network",
    "image_decode": "decode",
    "yuv_decode": "decode",
    "channel_swap": "decode",
    "queue": "queue",
    "preprocess": "inference",
    "inference": "inference",
    "server": "server",
    "return": "return",
}
"""Fine stage -> group, in the order of the path, for any transport; a transport declares further ones.
`connect` appears if a client is built per request, `preprocess` (an engine's work before its model: slicing, resizing,
tokenising) if the engine reports it, `server` if the server is a black box without reports (last byte packed -> first
token)."""


def path_of(transports: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Join the common stages and those that transports declare, in the order of the path.

    In each group the declared stages come last up to `network`, and first after it: what is packed last is unpacked
    first.
    """
    declared = {stage: group for stages in transports for stage, group in stages.items() if stage not in STAGES}
    out = GROUPS.index("network")
    table: dict[str, str] = {}
    for place, name in enumerate(GROUPS):
        for stages in (STAGES, declared) if place <= out else (declared, STAGES):
            table |= {stage: group for stage, group in stages.items() if group == name}
    return table


NAME_LIMIT: Final = 64
"""Letters of a fact's name."""

FACT_LIMIT: Final = 1 << 53
"""No fact is larger: floats skip whole numbers above; in ms these are 300,000 years."""

STAMPS: Final = range(1 << 62)
"""Valid times in ns: their differences fit 64 bits."""


@dataclass(slots=True)
class Remote:
    """A server's report about one request, in its last message.

    ``frame_stamp_ns`` and ``frame_marks`` belong to stream mode: the ROS-time stamp of the cached frame that was used,
    and its marks in the server.
    """

    clock: str
    marks: list[Mark] = field(default_factory=list)
    token_ns: list[int] = field(default_factory=list)
    frame_stamp_ns: int = -1
    frame_marks: list[Mark] = field(default_factory=list)
    facts: dict[str, float] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)
    """`provenance.Provenance.to_dict`; empty if the server reports none."""

    @staticmethod
    def of_json(value: Mapping[str, Any]) -> Remote:
        """Read a server's JSON; raises ValueError, KeyError or TypeError if it is malformed."""
        return Remote(
            clock=value["clock"],
            marks=[(stage, stamp) for stage, stamp in value["marks"]],
            token_ns=value["token_ns"],
            frame_stamp_ns=value["frame_stamp_ns"],
            frame_marks=[(stage, stamp) for stage, stamp in value["frame_marks"]],
            facts=value["facts"],
            provenance=value.get("provenance", {}),
        ).check()

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def shifted(self, offset_ns: int) -> Remote:
        """Return the report on this host's clock, which the server's is ``offset_ns`` ahead of."""
        return replace(
            self,
            clock=clock_id(),
            marks=[(stage, stamp - offset_ns) for stage, stamp in self.marks],
            token_ns=[stamp - offset_ns for stamp in self.token_ns],
            frame_marks=[(stage, stamp - offset_ns) for stage, stamp in self.frame_marks],
        )

    def check(self) -> Remote:
        """Return the report; raises ValueError if its values, which come from outside, are impossible."""
        marks = [*self.marks, *self.frame_marks]
        if not all(isinstance(text, str) for text in (self.clock, *(stage for stage, _ in marks))):
            raise ValueError("marks whose stages are not text")
        for stamp in (*self.token_ns, *(stamp for _, stamp in marks), max(self.frame_stamp_ns, 0)):
            if type(stamp) is not int or stamp not in STAMPS:
                raise ValueError("marks whose times are invalid")
        if not isinstance(self.facts, Mapping):
            raise ValueError("facts without names")  # noqa: TRY004 - one type of error for data from outside
        if not isinstance(self.provenance, Mapping):
            raise ValueError("a provenance without names")  # noqa: TRY004 - as above
        return self


@dataclass(slots=True, eq=False)
class Trace:
    """The record of one request on one side of the wire.

    ``token_ns`` holds the times at which tokens left the engine; ``facts`` are reported by the engine or a black-box
    server (llama.cpp's ``timings`` and the like), and ``odd`` names those with impossible values. A client's ``remote``
    is the server's report. ``later`` holds facts that take time: they are computed once the answer is sent.
    """

    marks: list[Mark] = field(default_factory=list)
    token_ns: list[int] = field(default_factory=list)
    facts: dict[str, float] = field(default_factory=dict)
    odd: set[str] = field(default_factory=set)
    later: dict[str, Callable[[], float]] = field(default_factory=dict)
    remote: Remote | None = None
    frame_stamp_ns: int = -1
    frame_marks: list[Mark] = field(default_factory=list)
    provenance: dict[str, str] = field(default_factory=dict)

    def mark(self, stage: str) -> None:
        """Attribute the time since the previous mark to ``stage``; costs about 0.15 us."""
        self.marks.append((stage, now_ns()))

    def receive(self, remote: Remote) -> None:
        self.remote = remote
        self.learn(remote.facts)

    def learn(self, facts: Mapping[str, Any]) -> None:
        """Keep a server's facts; an impossible value (NaN, 1e300, text) stays absent and is ``odd``."""
        for name, value in facts.items():
            if not (isinstance(name, str) and name.isidentifier() and len(name) < NAME_LIMIT):
                self.odd.add("an invalid name")
            elif type(value) in {int, float} and abs(value) <= FACT_LIMIT:
                self.facts[name] = value
            else:
                self.odd.add(name)

    def to_remote(self) -> Remote:
        self.facts |= {name: find() for name, find in self.later.items()}
        self.later = {}
        facts = {str(name): value for name, value in self.facts.items()}  # not every serialiser takes a subclass of str
        return Remote(
            clock_id(), self.marks, self.token_ns, self.frame_stamp_ns, self.frame_marks, facts, self.provenance
        )

    def chain(self) -> list[Mark]:
        """Join both sides' marks in order of time; of another clock's all up to the answer is the stage `server`."""
        if self.remote is None:
            return list(self.marks)
        if self.remote.clock != clock_id():
            return [("server" if stage == "return" else stage, stamp) for stage, stamp in self.marks]
        return sorted([*self.marks, *self.remote.marks], key=lambda mark: mark[1])


@dataclass(frozen=True, slots=True)
class Budget:
    """Durations derived from one chain, in ns: stages and residual sum to ``e2e_ns`` exactly."""

    stages_ns: dict[str, int]
    residual_ns: int
    e2e_ns: int

    @property
    def e2e_without_inference_ns(self) -> int | None:
        """Return e2e minus inference and preprocessing: the only reading of the paper's 101.8 and 15.5 ms."""
        if "inference" not in self.stages_ns:
            return None
        return self.e2e_ns - self.stages_ns["inference"] - self.stages_ns.get("preprocess", 0)

    @property
    def e2e_without_model_ns(self) -> int | None:
        """Return e2e minus the model's time, or None if the engine does not report its preprocessing."""
        reported = {"preprocess", "inference"} <= self.stages_ns.keys()
        return self.e2e_ns - self.stages_ns["inference"] if reported else None

    @property
    def residual_share(self) -> float | None:
        whole = self.e2e_without_inference_ns
        return None if not whole else self.residual_ns / whole


def budget(chain: Iterable[Mark]) -> Budget:
    """Derive the durations of a chain; stretches of one stage are summed."""
    marks = iter(chain)
    spent = {RESIDUAL: 0}
    _, first = next(marks, (RESIDUAL, 0))
    previous = first
    for stage, now in marks:
        spent[stage] = spent.get(stage, 0) + now - previous
        previous = now
    return Budget(spent, spent.pop(RESIDUAL), previous - first)


def mark_cost_ns(repeats: int = 20_000) -> float:
    mark = Trace().mark
    start = now_ns()
    for _ in range(repeats):
        mark("capture")
    return (now_ns() - start) / repeats
