"""Shares of valid skills with a grammar and without: the tables of a run, and its ``--json`` object."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from s2a_bench.errors import StoreError
from s2a_bench.experiments import Shown
from s2a_bench.experiments.model_validity.cell import Tokens, ValidityCell
from s2a_bench.experiments.model_validity.rows import VALIDITY
from s2a_bench.policy.conformal import upper_bound
from s2a_bench.store.manifest import present
from s2a_bench.writers.as_json import frame
from s2a_bench.writers.tables import ABSENT, DUMMY, Note, TextTable

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import Run

_TAIL = 0.975
"""Each end of a two-sided 95 % interval."""


@dataclass(frozen=True, slots=True)
class Share:
    """So many of so many."""

    count: int
    of: int

    @property
    def value(self) -> float | None:
        """Return the share; None of nothing."""
        return self.count / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Return the two-sided 95 % interval of Clopper and Pearson (Biometrika 1934); None of nothing."""
        if not self.of:
            return None
        return 1 - upper_bound(self.of - self.count, self.of, _TAIL), upper_bound(self.count, self.of, _TAIL)

    def __str__(self) -> str:
        """Write the share with its interval, in percent."""
        if (value := self.value) is None or (ends := self.interval) is None:
            return ABSENT
        return f"{100 * value:.1f} [{100 * ends[0]:.1f}, {100 * ends[1]:.1f}]"


@dataclass(frozen=True, slots=True)
class Arm:
    """The answers of one format, with the grammar or without."""

    about: dict[str, Any]
    """The format as the manifest has it."""
    grammar: bool
    answers: int
    valid: Share
    """Skills among the lines that count."""
    as_ordered: Share
    """Answers that are exactly the wanted number of skills."""
    cut: int
    problems: dict[str, int] = field(default_factory=dict)


def arms_of(run: Run) -> list[Arm]:
    """Count a run's answers; raises StoreError where the folder holds none."""
    rows = run.table(VALIDITY)
    if rows.empty:
        raise StoreError(f"{run.path} holds no answers; run s2a-bench model validity first")
    formats = {about["name"]: about for about in run.manifest["formats"]}
    return [
        _arm(formats[str(name)], bool(grammar), part)
        for (name, grammar), part in rows.groupby(["format", "grammar"], sort=False)
    ]


def show(run: Run, **_: Any) -> Shown:
    """Return what a run shows; raises StoreError where the folder holds no answers."""
    tables = validity_tables(run)
    return Shown(
        sentences=[f"{len(run.table(VALIDITY))} answers to the prompts were parsed, skill by skill."],
        tables=tables,
        main=["validity"],
        notes=tables["validity"].notes,
        json=lambda: validity_json(run),
    )


def validity_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name."""
    arms = arms_of(run)
    tables = {"validity": _shares(run, arms), "formats": _formats(run)}
    if kinds := list(dict.fromkeys(kind for arm in arms for kind in arm.problems)):
        lines = [(*_names(arm), *(str(arm.problems.get(kind, 0)) for kind in kinds)) for arm in arms if arm.problems]
        tables["problems"] = TextTable("Lines that are no skill", ("L", "grammar", *kinds), lines, 2)
    return tables


def validity_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; a cell a format and way to ask."""
    return frame(run, [_cell(run, arm) for arm in arms_of(run)], [])


def _arm(about: dict[str, Any], grammar: bool, rows: pd.DataFrame) -> Arm:
    problems: Counter[str] = Counter()
    for text in rows["problems"]:
        problems.update(json.loads(text))
    return Arm(
        about,
        grammar,
        len(rows),
        Share(int(rows["skills"].sum()), int(rows["lines"].sum())),
        Share(int(rows["as_ordered"].sum()), len(rows)),
        int(rows["cut"].sum()),
        dict(problems),
    )


def _cell(run: Run, arm: Arm) -> dict[str, Any]:
    """Return one cell; a share of nothing is an absent key."""
    about = arm.about
    cell = ValidityCell(
        format=about["name"],
        wording=about["wording"],
        example=about["example"],
        tokens_per_skill=Tokens(**about["tokens_per_skill"]),
        skill_set=about["skill_set"],
        n_skills=run.manifest["configuration"]["n_skills"],
        grammar=arm.grammar,
        emulated=False,
        dummy=bool(run.manifest["model"]["dummy"]),
        answers=arm.answers,
        cut=arm.cut,
        lines=arm.valid.of,
        skills=arm.valid.count,
        problems=arm.problems,
        share=arm.valid.value,
        share_ci95=arm.valid.interval,
        as_ordered=arm.as_ordered.count,
        as_ordered_share=arm.as_ordered.count / arm.answers,
        as_ordered_share_ci95=arm.as_ordered.interval,
    )
    return present(cell)


def _names(arm: Arm) -> tuple[str, str]:
    return arm.about["name"], "with" if arm.grammar else "without"


def _shares(run: Run, arms: list[Arm]) -> TextTable:
    """Lay out the shares, a line a format and way to ask."""
    asked = run.manifest["configuration"]
    lines: list[tuple[str, ...]] = [
        (*_names(arm), f"{arm.valid.count} of {arm.valid.of}", str(arm.valid), str(arm.as_ordered)) for arm in arms
    ]
    header = ("L", "grammar", "valid lines", "share (%)", f"answers of exactly {asked['n_skills']} skills (%)")
    title = f"Valid skills: {arms[0].about['skill_set']}, N = {asked['n_skills']}, {asked['answers']} answers each"
    rules = frozenset(
        place for place, arm in enumerate(arms) if place and arms[place - 1].about["name"] != arm.about["name"]
    )
    return TextTable(title, header, lines, 2, rules, tuple(_notes(run, arms)))


def _formats(run: Run) -> TextTable:
    """Return what was asked for, and what it costs with this model."""
    lines: list[tuple[str, ...]] = [
        (
            about["name"],
            about["wording"],
            about["example"].replace("\n", ""),
            "{least} / {mean:.3g} / {most}".format(**about["tokens_per_skill"]),
        )
        for about in run.manifest["formats"]
    ]
    return TextTable("Formats", ("L", "wording", "example", "tokens a skill: least / mean / most"), lines, 3)


def _notes(run: Run, arms: list[Arm]) -> Iterator[str]:
    """Return what a reader must know besides the numbers."""
    yield "[]: 95 % Clopper-Pearson; for lines as if they were independent, which those of one answer are not."
    yield f"The first {run.manifest['configuration']['n_skills']} lines of an answer count. One prompt, no picture."
    if run.manifest["model"]["dummy"]:
        chance = "DUMMY WEIGHTS: without a grammar this is what chance gives; it says nothing about any real model."
        yield Note(chance, DUMMY)
    free = [arm for arm in arms if not arm.grammar]
    if cut := sum(arm.cut for arm in free):
        answers = sum(arm.answers for arm in free)
        yield f"{cut} of {answers} answers without grammar were cut off at their most tokens (--max-tokens)."
