"""The scenario as files: valid against the standard's schema, and the ego's skills at their times."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

pytest.importorskip("scenariogeneration", reason="no wheel of pyclothoids on this platform")

from s2a_bench.errors import MissingExtra, UsageError
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.plans import prepare
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.openscenario import problems, write_openscenario
from s2a_bench.scenario.ccrb.options import CcrbOptions


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("lane_change", [False, True])
def test_the_files_are_valid_openscenario(tmp_path: Path, gap: str, lane_change: bool) -> None:
    config = CcrbConfig(scenario=CcrbOptions(gap=gap, lane_change=lane_change), simulator="embedded", ttc=True)
    ready = prepare(config)
    written = write_openscenario(tmp_path / "ccrb.xosc", config.scenario, ready.schedules)
    names = ["ccrb.xodr", *(f"ccrb-{name}.xosc" for name in ready.schedules)]
    assert [path.name for path in written] == names
    for path in written[1:]:
        assert problems(path) == []


def test_each_skill_begins_when_its_policy_starts_it(tmp_path: Path) -> None:
    config = CcrbConfig()
    ready = prepare(config)
    write_openscenario(tmp_path / "ccrb.xosc", config.scenario, ready.schedules)
    for name, schedule in ready.schedules.items():
        tree = ET.parse(tmp_path / f"ccrb-{name}.xosc")  # noqa: S314 - our own file
        begins = [
            float(event.find(".//SimulationTimeCondition").get("value"))  # type: ignore[union-attr, arg-type]
            for event in tree.iter("Event")
            if "ego-skill" in event.get("name", "")
        ]
        assert begins == pytest.approx(schedule.start_s[:, 0])
        gaps = [event for event in tree.iter("Event") if "ego-gap" in event.get("name", "")]
        assert len(gaps) == (4 if name == "naive" else 0)


def test_the_cars_stand_a_gap_and_a_length_apart(tmp_path: Path) -> None:
    config = CcrbConfig(scenario=CcrbOptions(front_gap_m=12, rear_gap_m=9))
    ready = prepare(config)
    path = write_openscenario(tmp_path / "ccrb.xosc", config.scenario, ready.schedules)[1]
    places = {
        private.get("entityRef"): float(private.find(".//LanePosition").get("s"))  # type: ignore[union-attr, arg-type]
        for private in ET.parse(path).iter("Private")  # noqa: S314 - our own file
    }
    assert np.diff([places["rear"], places["ego"], places["lead"]]) == pytest.approx([9 + 5, 12 + 5])


def test_a_wrong_file_has_problems(tmp_path: Path) -> None:
    path = tmp_path / "bad.xosc"
    path.write_text("<OpenSCENARIO><FileHeader/></OpenSCENARIO>")
    assert problems(path)


def test_other_endings_are_refused(tmp_path: Path) -> None:
    ready = prepare(CcrbConfig())
    with pytest.raises(UsageError, match=r"should end in \.xosc"):
        write_openscenario(tmp_path / "ccrb.xml", CcrbOptions(), ready.schedules)


def test_without_the_package_the_way_to_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ready = prepare(CcrbConfig())
    monkeypatch.setitem(sys.modules, "scenariogeneration", None)
    with pytest.raises(MissingExtra, match=r"pip install 's2a-bench\[scenario\]'"):
        write_openscenario(tmp_path / "ccrb.xosc", CcrbOptions(), ready.schedules)
