"""Random modes with random latencies, and the plain robot of each."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.modes import ControlSetting, Mode, mode
from s2a_bench.plugins.chunks.modes.aggregate import WEIGHTS, Aggregate
from s2a_bench.plugins.chunks.modes.append import Queue, Streamed, Sync
from s2a_bench.plugins.chunks.modes.replace import Replace
from tests.plugins.chunks.modes.plain import Aggregates, Appends, Log, Replaces


def agree(some: tuple[Any, ...], others: tuple[Any, ...]) -> None:
    """Compare arrays field by field."""
    for one, other in zip(some, others, strict=True):
        for field in fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), field.name)


@st.composite
def settings_of_chunks(draw: st.DrawFn) -> ControlSetting:
    return ControlSetting(
        draw(st.sampled_from([1, 2, 7, 20])), draw(st.integers(1, 10)), draw(st.sampled_from(["floor", "ceil"]))
    )


@st.composite
def latencies(draw: st.DrawFn, setting: ControlSetting) -> Any:
    most = draw(st.sampled_from([1, 2, setting.horizon, 3 * setting.horizon])) * setting.period_ns
    return np.array(draw(st.lists(st.integers(0, most), max_size=12)), np.int64)


@st.composite
def modes(draw: st.DrawFn, setting: ControlSetting, name: str) -> Mode:
    execute, trigger = st.integers(1, setting.horizon), st.integers(0, setting.horizon + 2)
    if name == "sync":
        return mode(f"sync?execute={draw(execute)}")
    if name == "queue":
        return mode(f"queue?trigger={draw(trigger)}&execute={draw(execute)}")
    if name == "streamed":
        gap = draw(st.integers(0, 3 * setting.period_ns)) * 1e-9
        return Streamed(draw(trigger), draw(execute), gap, draw(st.sampled_from(["safe", "naive"])))
    if name == "replace":
        under_way = draw(st.sampled_from(["one", "many"]))
        return mode(f"replace?execute={draw(execute)}&under_way={under_way}&assumed={draw(st.integers(-1, 11))}")
    return mode(f"aggregate?trigger={draw(trigger)}&kind={draw(st.sampled_from(list(WEIGHTS)))}")


@st.composite
def cases(draw: st.DrawFn, name: str) -> tuple[Mode, Any, ControlSetting]:
    setting = draw(settings_of_chunks())
    return draw(modes(setting, name)), draw(latencies(setting)), setting


def plainly(made: Mode, latency_ns: Any, setting: ControlSetting) -> Log:
    common = (latency_ns.tolist(), setting.period_ns, setting.horizon, setting.rounding, made.gap_ns)
    match made:
        case Sync():
            return Appends(*common, execute=made.execute or setting.horizon).run()
        case Queue():
            return Appends(*common, trigger=made.trigger, execute=made.execute or setting.horizon).run()
        case Streamed():
            length = made.execute or setting.horizon
            behind = max(0, (length - 1) * (made.gap_ns - setting.period_ns)) if made.start == "safe" else 0
            hold = -(-behind // setting.period_ns)
            return Appends(*common, trigger=made.trigger, execute=length, hold=hold).run()
        case Replace():
            return Replaces(*common, execute=made.execute, many=made.under_way == "many", assumed=made.assumed).run()
        case Aggregate():
            return Aggregates(*common, trigger=made.trigger, weight=WEIGHTS[made.kind]).run()
    raise AssertionError(made.name)
