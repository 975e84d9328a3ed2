"""References: what others published, which runs are held against on request (``--against NAME``).

Nothing of a reference is a measurement of ours: views draw its bars in grey, and a report judges its claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import UsageError
from s2a_bench.options import Options, option
from s2a_bench.registry import Registry

if TYPE_CHECKING:
    from s2a_bench.writers.figures import Bar


@dataclass(frozen=True, slots=True)
class GreyBars:
    """Bars of a reference beside those of a run: the label of their legend, and the notes of the caption."""

    label: str = ""
    bars: tuple[Bar, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Reference:
    """The declaration of one reference; what it names as ``module:attribute`` is imported when it is needed."""

    title: str
    """Its name in sentences, such as "the paper"."""
    source: str
    """Its full name, such as "the Stream-to-Act paper"."""
    bars: Mapping[str, str] = field(default_factory=dict)
    """Name of a figure -> its `GreyBars`."""
    claims: str = ""
    """Function ``runs -> [report.verdicts.ClaimVerdict]``; empty: it claims nothing."""
    note: str = ""
    """A note below the table of its claims."""


REFERENCES: Final[Registry[Reference]] = Registry("references", "against", {})


def against(about: str) -> str:
    """Return the option of a reference's name; ``about`` says what is done with each, {} being what it is called.

    No reference is loaded: this runs while its module may be under way.
    """
    offered = [f"{name}: {about.format(f'the {name}')}" for name in REFERENCES]
    field: str = option("", "; ".join(offered), hidden=not offered)
    return field


def check_name(name: str, advice: str = "") -> None:
    """Raise UsageError, with ``advice``, for the name of no reference, and for a package that does not load."""
    if name and name not in REFERENCES:
        names = " or ".join(REFERENCES) or "left out, as no installed package offers anything to be held against"
        raise UsageError(f"`against`: '{name}' should be {names}{advice}")
    bars_of(name, "")


def bars_of(name: str, figure: str) -> GreyBars:
    """Return the numbers that a reference has beside a figure; none if ``name`` is empty."""
    where = REFERENCES[name].bars.get(figure) if name else None
    reference_bars: GreyBars = resolve_name(where) if where else GreyBars()
    return reference_bars


class AgainstReference(Options):
    against: str = against("draw {}'s values beside ours")

    def check(self) -> None:
        check_name(self.against)
