"""The options of a run of chunks: modes, rules and latencies; live, its requests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Annotated, Final

from pydantic import BeforeValidator

from s2a_bench.act import ROBOTS, ActionKind, kind
from s2a_bench.boards.latency import EXAMPLE
from s2a_bench.boards.profile import profile_files
from s2a_bench.errors import UsageError
from s2a_bench.options import Names, group, one_of, option
from s2a_bench.plugins.chunks.latencies import Source, sources, split
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode
from s2a_bench.plugins.chunks.options import SHOWN, ControlOptions, LoopRequests
from s2a_bench.policy.conformal import GUARANTEE, Guarantee, fewest
from s2a_bench.transport import ACTIONS

RULES: Final = ("calibrated", "tracked", "maximum", "mean", "oracle")
PROMISING: Final = ("calibrated", "tracked")
"""Rules that keep to `epsilon`, given enough latencies."""
CYCLES: Final = 10_000
CALIBRATION: Final = 8_000
VIRTUAL: Final = ("cycles", "calibration_cycles", "tokens_per_action")
FASTEST_LIVE_HZ: Final = 10_000.0
MOST_LIVE_TICKS: Final = 1_000_000

Sources = Annotated[tuple[str, ...], BeforeValidator(split, json_schema_input_type=tuple[str | float, ...])]
"""Sources of latencies; as text they are separated by commas, and so are the parameters of a family."""


class ChunksConfig(ControlOptions):
    """Modes and rules under latencies."""

    latency: Sources = option(
        (EXAMPLE,),
        "observation to usable chunk (with streamed: to its first action): ms, FAMILY:mean_ms=...,key=value, FILE.csv, "
        "a run folder, or a profile; several with commas",
        first=True,
        names=profile_files,
    )
    slow_down: float = option(1.0, "all actions so many times slower (time-scaling)", ge=1, le=1000)
    slowest: float = option(
        1.0, "so many times slower calibrated and oracle may make actions where no trigger is enough", ge=1, le=1000
    )
    control_hz: float = option(50.0, "control ticks a second", ge=1e-3, le=1e6, allow_inf_nan=False)
    rules: Annotated[Names, one_of(lambda: RULES)] = option(
        RULES,
        "further rows for the first queue, its trigger chosen by each; empty text for none "
        f"[default: {','.join(RULES)}; --live: none]",
        first=True,
    )
    epsilon: float = option(0.01, "share of cycles that may stall, for the rules", flag="eps", gt=0, lt=1)
    guarantee: Guarantee = GUARANTEE
    cycles: int | None = option(
        None, f"requests of each row [default: {CYCLES}; replayed: as many as there are]", ge=2, le=1_000_000
    )
    calibration_cycles: int = option(
        CALIBRATION, "further requests that the rules learn from; of a recording its first half at most", ge=1
    )
    tokens_per_action: int = option(7, "tokens of an action, where a profile answers", ge=1, le=1000)
    shown_ticks: int = option(
        120, "control ticks of each row that are drawn, and in virtual time kept", ge=0, le=100_000
    )
    robot: str = option(
        "plant",
        "what takes the actions: plant?frequency_hz=5&damping=1, live also ros?topic=/NAME, call?function=MODULE:NAME; "
        "empty text for none",
        first=True,
        names=lambda: ROBOTS,
    )
    export_delays: Path | None = option(
        None, "also write each request's times, L and d as CSV, for other simulators; of one source of latencies"
    )
    live: bool = option(
        False,
        "act in real time on what a server answers; with `engine` echo, `latency` is how long its answers take",
        first=True,
    )
    seconds: float = option(20.0, "--live: how long each mode acts", gt=0, le=86_400)
    requests: LoopRequests = group(LoopRequests, only=SHOWN, about="--live: ", first=("transports",))

    @property
    def virtual(self) -> bool:
        return not self.live

    @cached_property
    def live_requests(self) -> LoopRequests:
        """The requests of a live control loop; raises UsageError naming the field."""
        return self.requests.of_robots(ACTIONS, self.known, self)

    @property
    def known(self) -> str:
        """The latencies that our live server keeps; empty if it answers as fast as it can."""
        return self.latency[0] if "latency" in self.model_fields_set else ""

    def named(self, pipeline: str) -> str:
        return f"{pipeline}, {self.known}" if self.known else pipeline

    @property
    def setting(self) -> ControlSetting:
        return super().setting.slowed(self.slow_down)

    @cached_property
    def sources(self) -> tuple[Source, ...]:
        return tuple(
            each for written in self.latency for each in sources(written, self.horizon * self.tokens_per_action)
        )

    @cached_property
    def plant(self) -> ActionKind | None:
        if not self.robot:
            return None
        found = kind(self.robot, ActionKind)
        if not found.simulated:
            name = self.robot.partition("?")[0]
            raise UsageError(f"`robot`: {name}: virtual time has no actions to send; name a plant, or nothing")
        return found

    @cached_property
    def rules_tried(self) -> Sequence[str]:
        """The rules; by default none live, and none with too few latencies to learn from."""
        if "rules" in self.model_fields_set:
            return self.rules
        return () if self.live else tuple(rule for rule in self.rules if rule not in PROMISING or not self.too_few)

    @cached_property
    def too_few(self) -> str:
        """The source with too few latencies for a rule that keeps to `epsilon`, as text; else empty."""
        needed = fewest(self.epsilon)
        return next(
            (
                f"{each.name} has {self._learnable(each)} latencies to learn from (of a recording the first half); "
                f"a stall in {self.epsilon:.2%} of the cycles takes {needed}"
                for each in self.sources
                if self._learnable(each) < needed
            ),
            "",
        )

    def _learnable(self, source: Source) -> int:
        recorded = source.recorded_ns
        return self.calibration_cycles if recorded is None else min(self.calibration_cycles, recorded.size // 2)

    def learnt(self, source: Source) -> int:
        return self._learnable(source) if self.with_rules else 0

    @cached_property
    def triggered(self) -> Mode | None:
        return next((each for each in self.control.modes.values() if each.triggered), None)

    @property
    def with_rules(self) -> bool:
        return bool(self.rules_tried) and self.triggered is not None

    def check(self) -> None:
        """Refuse what makes no sense together; raises UsageError naming the fields."""
        super().check()
        if not self.latency:
            raise UsageError("`latency`: name at least one")
        if self.live:
            self._check_live()
            return
        if alone := next(chain(self.requests.given(), {"seconds"} & self.model_fields_set), ""):
            raise UsageError(f"`{alone}` is for a control loop that runs; it needs `live`")
        self._check_export()
        _ = self.plant
        for source in self.sources:
            recorded = source.recorded_ns
            if recorded is not None and recorded.size - self.learnt(source) < 2:  # noqa: PLR2004 - a boundary
                kept = f", and `rules` set {self.learnt(source)} aside" if self.learnt(source) else ""
                raise UsageError(
                    f"`latency`: {source.name} has {recorded.size} latencies{kept}; two or more are needed"
                )
        if self.with_rules and self.too_few and {*PROMISING} & {*self.rules_tried}:
            others = ",".join(rule for rule in RULES if rule not in PROMISING)
            raise UsageError(f"`rules`: {self.too_few}; raise `epsilon`, or take `rules` {others}")

    def _check_live(self) -> None:
        if self.robot:
            kind(self.robot, ActionKind)
        given = self.model_fields_set
        if alone := next((field for field in VIRTUAL if field in given), ""):
            raise UsageError(f"`{alone}` is for virtual time; live there are `seconds` and `warmup`")
        self._check_ticks()
        self._check_learning()
        if self.known and len(self.latency) > 1:
            raise UsageError(f"`latency`: live a server keeps one, not {len(self.latency)}; run once for each")
        if len(self.live_requests.pipelines) > 1 and self.export_delays is not None:
            raise UsageError("`export_delays`: of one `transport` at a time")
        self._check_file()

    def _check_ticks(self) -> None:
        if self.seconds * 1e9 < 2 * self.setting.period_ns:
            raise UsageError(
                f"`seconds`: {self.seconds:g} s are less than two ticks at `control_hz` {self.control_hz:g}"
            )
        if self.control_hz > FASTEST_LIVE_HZ:
            raise UsageError(
                f"`control_hz`: {self.control_hz:g}: a live loop keeps up with at most {FASTEST_LIVE_HZ:g} Hz; lower it"
            )
        if self.seconds * self.control_hz > MOST_LIVE_TICKS:
            raise UsageError(
                f"`seconds`: {self.seconds:g} s at `control_hz` {self.control_hz:g} are over {MOST_LIVE_TICKS:.0e} "
                "control ticks, which are held in memory; act for a shorter time"
            )

    def _check_learning(self) -> None:
        if "oracle" in self.rules_tried:
            raise UsageError("`rules`: a live run has no oracle; take calibrated, tracked, maximum or mean")
        if {*PROMISING} & {*self.rules_tried} and self.with_rules:
            needed = fewest(self.epsilon)
            if self.requests.warmup < needed:
                raise UsageError(
                    f"`warmup`: {self.requests.warmup} requests are too few to learn from for `epsilon` "
                    f"{self.epsilon:g}; take {needed} or more, or other `rules`"
                )

    def _check_export(self) -> None:
        if self.export_delays is None:
            return
        if len(self.sources) != 1:
            names = ", ".join(source.name for source in self.sources)
            raise UsageError(f"`export_delays`: {len(self.sources)} sources of `latency`, {names}; name one of them")
        self._check_file()

    def _check_file(self) -> None:
        file = self.export_delays
        if file is not None and (file.suffix != ".csv" or not file.parent.is_dir()):
            raise UsageError(f"`export_delays`: {file} should be a .csv file in a folder that there is")

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        if self.robot and (risk := kind(self.robot, ActionKind).risk):
            yield "robot", risk, self.robot
