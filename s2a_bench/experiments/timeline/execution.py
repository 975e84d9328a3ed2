"""Execution in real time: several policies side by side on one stream of tokens, each with its executor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from s2a_bench.act import SkillRobot
from s2a_bench.act.events import AbortRequested, Event, LiveInbox
from s2a_bench.act.executor import Executor
from s2a_bench.act.record import Record, executed
from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.experiments.timeline.build_rows import timeline_rows
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.policies import finite
from s2a_bench.harness.timelines.rows import skill_rows
from s2a_bench.plan import Gap
from s2a_bench.policy import TOLERANCE_S, PlanShape, Policy
from s2a_bench.stats import summarise
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.run import RunWriter


class SideBySide:
    """One executor a policy; all receive the same events. Use as a context manager; leaving it early aborts them."""

    def __init__(
        self, policies: Mapping[str, Policy], shape: PlanShape, gap: Gap, robots: Sequence[SkillRobot], silence_s: float
    ) -> None:
        """Create the executors: one robot a policy; ``policies`` by their recorded names."""
        self._inboxes = [LiveInbox() for _ in policies]
        clock = SystemClock()
        self._executors = [
            Executor(policy, shape, robot, inbox, clock, gap=gap, silence_s=silence_s, name=name)
            for (name, policy), robot, inbox in zip(policies.items(), robots, self._inboxes, strict=True)
        ]
        self._pool = ThreadPoolExecutor(len(policies), "executor")
        self._futures: list[Future[Record]] = []

    @property
    def records(self) -> list[Record]:
        return [executor.record for executor in self._executors]

    def send(self, event: Event) -> None:
        for inbox in self._inboxes:
            inbox.put(event)

    def finish(self) -> None:
        for future in self._futures:
            future.result()

    def __enter__(self) -> SideBySide:  # noqa: PYI034 - Self is typing's since 3.11
        self._futures = [self._pool.submit(executor.run) for executor in self._executors]
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.send(AbortRequested(now_ns(), "the run was ended"))
        self._pool.shutdown()


def keep(
    writer: RunWriter,
    setting: PlanSetting,
    plan: int,
    request_id: str,
    policies: Mapping[str, Policy],
    records: Sequence[Record],
) -> list[RunWarning]:
    """Write the rows of the skills that ran, and return the warnings.

    A rate of 0 means too few tokens to measure it: then no rows are written.
    """
    for record in records:
        cell = f"{setting.name}/{record.policy}"
        writer.update(executions={f"{cell}/{plan}": _facts(record)})
        if record.ran and record.requested_ns is not None and setting.tokens_per_s > 0:
            plans, schedule, due_s = executed(record)
            timeline = timeline_rows(
                setting,
                record.policy,
                plans,
                schedule,
                [request_id],
                first_plan=plan,
                requested_ns=[record.requested_ns],
                cautions=[finite(policies[record.policy].caution)],
                tolerance_s=TOLERANCE_S,
            )
            texts = [[str(skill.call) for skill in record.ran]]
            writer.append(TIMELINES, timeline)
            writer.append(
                SKILLS, skill_rows(cell, plans, schedule, [request_id], first_plan=plan, texts=texts, due_s=due_s)
            )
    return list(_warnings(setting, plan, records))


def jitter_facts(records: Sequence[Record]) -> dict[str, float | int]:
    """Summarise the start jitter of all skills; empty without skills."""
    values = [skill.jitter_ns / 1e6 for record in records for skill in record.skills]
    if not values:
        return {}
    summary = summarise(values)
    return {"starts": summary.n, "median_ms": summary.median, "p99_ms": summary.p99}


def _facts(record: Record) -> dict[str, Any]:
    """Return the facts that the tables lack: the plan's outcome, and every order with its time in ms."""
    zero_ns = record.requested_ns or 0
    return {
        "outcome": record.outcome,
        **({"why": record.why} if record.why else {}),
        **({"extra_skills": record.extra} if record.extra else {}),
        "arrived": len(record.arrivals),
        "started": len(record.skills),
        "start_jitter": jitter_facts([record]),
        "orders": [[round((order.at_ns - zero_ns) / 1e6, 3), order.what, order.index + 1] for order in record.commands]
        if record.requested_ns is not None
        else [],
    }


def _warnings(setting: PlanSetting, plan: int, records: Sequence[Record]) -> Iterator[RunWarning]:
    ends: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.outcome != "completed":
            ends.setdefault((record.outcome or "unfinished", record.why), []).append(record)
    for (outcome, why), ended in ends.items():
        ran = ", ".join(f"{record.policy} {len(record.ran)}" for record in ended)
        yield RunWarning(
            f"plan-{outcome}",
            f"{setting.name}, plan {plan + 1}: {why}; the robots held after {ran} of {setting.n_skills} skills",
            "their numbers describe the skills that ran; see 'executions' in manifest.json",
        )
