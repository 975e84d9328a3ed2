"""Advice on a transport for a link: its options."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator

from s2a_bench.options import Options, Size, option
from s2a_bench.plugins.two_hosts.profiles import published

REFERENCE: Final = Path(__file__).resolve().parents[4] / "results" / "reference" / "transports"
CHECKED: Final = 2
"""Pipelines that `check` measures."""
LONGEST_PAUSE_S: Final = 5.0
"""Between its requests: TCP's window has fallen to its first by then."""
MB: Final = 1e6
_DURATION: Final = re.compile(r"(\d+\.?\d*)(ms|s)")


def _duration(text: str) -> str:
    if text and not _DURATION.fullmatch(text):
        raise ValueError(f"'{text}' should be a time, as 100ms or 0.5s")
    return text


class AdviseConfig(Options):
    """The link, and the requests that should go over it."""

    link: str = option(
        ..., f"{', '.join(published())}, a FILE, or rate=UP/DOWN,delay=MS, as in latency", names=published, first=True
    )
    rate: float = option(0.0, "requests a second that the link should carry; 0: without a pause", ge=0, le=10_000)
    deadline: Annotated[str, AfterValidator(_duration)] = option(
        "", "longest end to end without inference, as 100ms or 0.5s [default: none]"
    )
    size: Size = option((640, 480), "WIDTHxHEIGHT of the pictures [default: 640x480]")
    cameras: int = option(1, "pictures a request", ge=1, le=16)
    runs: list[Path] = option(
        (REFERENCE,),
        "folders of a `sweep transports` or of its runs, of the machine that is asked about "
        "[default: the reference run of the project, of another machine]",
    )
    measure: bool = option(
        False, f"also measure the first {CHECKED} on the emulated link, beside the prediction", flag="check"
    )
    output: Path = option(Path("results"), "folder for the runs of `check`")

    @property
    def deadline_ms(self) -> float:
        """The deadline, infinite for none."""
        found = _DURATION.fullmatch(self.deadline)
        return float(found[1]) * (1 if found[2] == "ms" else 1e3) if found else math.inf

    @property
    def period_ms(self) -> float:
        """From one request to the next; 0 for one after another."""
        return 1e3 / self.rate if self.rate else 0.0

    @property
    def pixels_mb(self) -> float:
        return self.size[0] * self.size[1] * 3 * self.cameras / MB
