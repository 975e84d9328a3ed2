"""The cells: each acting mode as given, and the first one with a trigger once more under each rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from s2a_bench.harness.warnings import change_warnings
from s2a_bench.plugins.chunks.chunks.config import CYCLES, RulesPlan
from s2a_bench.plugins.chunks.latencies import Source
from s2a_bench.plugins.chunks.modes import ControlSetting, Ints, Mode
from s2a_bench.plugins.chunks.modes.trigger import (
    Learning,
    Maximum,
    Mean,
    TriggerRule,
    calibrate,
    follow,
    greatest_trigger,
    trigger,
)
from s2a_bench.plugins.chunks.options import ControlPlan
from s2a_bench.policy.conformal import Calibration, Tracker
from s2a_bench.policy.parameters import canonical
from s2a_bench.stats.batches import Rows
from s2a_bench.stats.seeds import generator
from s2a_bench.store.manifest import RunWarning

GIVEN: Final = "given"
FOLLOW: Final = "take --rules tracked, whose trigger follows the delays"
_ORACLE_DRAWS: Final = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class LatencyDraw:
    """The latencies of one source in ns: those that are judged, and those that rules learn from."""

    source: Source
    judged: Ints
    learnt: Ints


@dataclass(frozen=True, slots=True, eq=False)
class ActingCell:
    """One acting mode under one source; ``triggers`` are a rule's, one a request."""

    mode: Mode
    name: str
    """The mode with its parameters, without the trigger if a rule chooses it."""
    rule: str
    latencies: LatencyDraw
    triggers: tuple[int, ...] = ()
    slower: float = 1.0
    """Factor by which its actions are executed more slowly (time-scaling)."""
    begin: Callable[[], TriggerRule] | None = None
    """Creates the rule that chooses a trigger after the other; None once all are chosen."""
    calibration: Calibration | None = None
    """The calibration of the rule `calibrated`."""

    @property
    def acting(self) -> Mode:
        if self.begin is not None:
            return Learning(self.mode, self.begin)
        return self.mode.varied(self.triggers) if self.triggers else self.mode

    @property
    def cell(self) -> str:
        rule = "" if self.rule == GIVEN else f", {self.rule}"
        return f"{self.name}{rule} @ {self.latencies.source.name}"

    def with_triggers(self, triggers: tuple[int, ...]) -> ActingCell:
        """Return the cell with the triggers that its rule chose; none: as it is."""
        return replace(self, triggers=triggers, begin=None) if triggers else self

    def followed(self, setting: ControlSetting) -> ActingCell:
        """Return the cell with the triggers that its rule chooses if it learns the judged latencies."""
        if self.begin is None:
            return self
        most = greatest_trigger(self.mode, setting)
        return self.with_triggers(tuple(follow(self.begin(), self.latencies.judged, setting, most).tolist()))


def draw(source: Source, cycles: int | None, learnt: int, seed: int) -> LatencyDraw:
    """Draw the latencies of a source, at most ``learnt`` for the rules; a recording keeps its order, and may end."""
    count = source.learnable(learnt)
    if source.recorded_ns is not None:
        judged = source.recorded_ns[count:]
        return LatencyDraw(source, judged[:cycles], source.recorded_ns[:count])
    rng, rules_rng = (generator(seed, key, source.name) for key in ("chunks", "chunks rules"))
    return LatencyDraw(source, source.draw(rng, cycles or CYCLES), source.draw(rules_rng, count))


def cells(control: ControlPlan, rules: RulesPlan, latencies: LatencyDraw) -> Iterator[ActingCell]:
    """Yield the cells of one source; a live one has no judged latencies yet."""
    for name, each in control.modes.items():
        yield ActingCell(each, name, GIVEN, latencies)
    mode, setting = rules.mode, control.setting
    if mode is None:
        return
    name = without_trigger(mode)
    for rule in rules.tried:
        if rule in {"calibrated", "oracle"}:
            fit = calibrate(latencies.learnt, rules.epsilon, rules.guarantee) if rule == "calibrated" else None
            limit_ns = fit.caution if fit else _oracle_ns(latencies.source, rules.epsilon, control.seed)
            fixed = trigger(limit_ns, setting, greatest_trigger(mode, setting))
            slower = min(fixed.beta, rules.slowest)
            yield ActingCell(mode, name, rule, latencies, (fixed.ticks,), slower, calibration=fit)
        else:
            yield ActingCell(mode, name, rule, latencies, begin=partial(_learner, rule, latencies, rules.epsilon))


def changes(setting: ControlSetting, name: str, latencies: LatencyDraw) -> list[RunWarning]:
    """Return warnings if the delays of judged latencies, in ticks, differ from those that a rule learned from."""
    learned, seen = (Rows(setting.delay_ticks(each).astype(float)) for each in (latencies.learnt, latencies.judged))
    return change_warnings(name, learned, seen, "control ticks", f"calibrate anew, or {FOLLOW}")


def without_trigger(mode: Mode) -> str:
    return canonical(mode.name, mode.varied((0,)))


def _learner(rule: str, latencies: LatencyDraw, epsilon: float) -> TriggerRule:
    if rule == "tracked":
        return Tracker(latencies.learnt.tolist(), epsilon)
    learner: TriggerRule = Maximum() if rule == "maximum" else Mean()
    for latency_ns in latencies.learnt.tolist():
        learner.learn(latency_ns, stalled=False)
    return learner


def _oracle_ns(source: Source, epsilon: float, seed: int) -> int:
    """Return the latency that at most a share epsilon exceeds of a million other draws, or of the whole recording."""
    latency_ns = source.recorded_ns
    if latency_ns is None:
        latency_ns = source.draw(generator(seed, "chunks oracle", source.name), _ORACLE_DRAWS)
    return int(np.sort(latency_ns)[-1 - int(epsilon * latency_ns.size)])
