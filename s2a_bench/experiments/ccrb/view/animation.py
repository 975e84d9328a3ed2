"""The animation of a CCRB run, drawn by highway-env: a road for each policy; GIF and MP4."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.errors import StoreError
from s2a_bench.experiments.ccrb.view.figures import path_of, rest_of
from s2a_bench.experiments.ccrb.view.outcomes import configuration, rollouts_of, tokens_line
from s2a_bench.scenario import EGO, LEAD, REAR, ROLES
from s2a_bench.scenario.ccrb.labels import OUTCOME_LABELS, law
from s2a_bench.scenario.ccrb.render import TopView
from s2a_bench.store.requests import SKILLS

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont

    from s2a_bench.store.run import StoredRun

FRAMES_A_S: Final = 20
WIDTH, ROAD_HEIGHT, TEXT_HEIGHT, FOOT_HEIGHT = 880, 96, 46, 40
"""Pixels; video codecs need even numbers."""
LAST_S: Final = 2.0
_PHASES: Final = {"waiting": "no skill yet: keeps its speed", "gap": "STALL: no skill is valid", "done": "plan done"}
_HITS: Final[dict[str, frozenset[int]]] = {
    "front": frozenset({LEAD, EGO}),
    "rear": frozenset({EGO, REAR}),
    "both": frozenset({EGO, REAR}),
}
_INK, _PAPER, _RED, _FAINT = (20, 20, 20), (255, 255, 255), (200, 60, 0), (110, 110, 110)


def animation_files(run: StoredRun) -> dict[str, Callable[[Path], None]]:
    """Return file name -> function that writes the animation in real time, or raises StoreError.

    A panel stops at its first impact: the time after it is not modelled.
    """
    drawn = cache(partial(_frames_of, run))

    def write(as_file: Callable[[Path, list[Image]], None], path: Path) -> None:
        try:
            path.parent.mkdir(exist_ok=True)
            as_file(path, drawn())
        except OSError as error:
            raise StoreError(f"cannot write {path}: {error}; the roll-outs are kept") from error

    return {"figures/scenario.gif": partial(write, _write_gif), "figures/scenario.mp4": partial(write, _write_film)}


def _frames_of(run: StoredRun, frames_a_s: int = FRAMES_A_S) -> list[Image]:
    panels = [RoadPanel(run, row) for row in rollouts_of(run, "point").to_dict("records")]
    until_s = max(panel.until_s for panel in panels)
    foot = f"{tokens_line(run)} Yellow: lead, green: ego, blue: car behind, red: impact.\n{law(configuration(run))}"
    return [_frame(panels, step / frames_a_s, foot) for step in range(int(until_s * frames_a_s) + 1)]


class RoadPanel:
    """One policy's road, and its text."""

    def __init__(self, run: StoredRun, row: dict[Any, Any]) -> None:
        self._row = row
        self._path = path_of(run, row["cell"])
        skills = run.table(SKILLS)
        self._texts = skills[skills["cell"] == row["cell"]]["text"].tolist()
        self._view = TopView(WIDTH, ROAD_HEIGHT)
        self._heading = _headings(self._path)
        self._hit_at = _first_impact(self._path, row["outcome"])
        self._last = rest_of(self._path) if self._hit_at is None else self._hit_at
        self.until_s = float(self._path["time_s"][self._last])

    def draw(self, at_s: float) -> tuple[NDArray[np.uint8], str, str, bool]:
        """Return the road's pixels, the policy with facts, the event, and whether that is an impact."""
        step_s = float(self._path["time_s"][1]) if len(self._path) > 1 else 1.0
        place = min(round(at_s / step_s), self._last)
        now = self._path.iloc[place]
        hit = self._hit_at is not None and place >= self._hit_at
        position = np.array([now[f"{car}_position_m"] for car in ROLES], dtype=float)
        lateral, heading = np.zeros(3), np.zeros(3)
        lateral[EGO], heading[EGO] = now["ego_lateral_m"], self._heading[place]
        crashed = _HITS[self._row["outcome"]] if hit else frozenset[int]()
        picture = self._view.picture(position, lateral, heading, crashed)
        facts = (
            f"{float(now['time_s']):5.2f} s   ego {float(now['ego_speed_kmh']):4.1f} km/h   "
            f"front gap {max(float(now['front_gap_m']), 0):4.1f} m   rear gap {max(float(now['rear_gap_m']), 0):4.1f} m"
        )
        return picture, f"{self._row['policy']}   {facts}", self._event(now, hit=hit), hit

    def _event(self, now: Any, *, hit: bool) -> str:
        if hit:
            speed = self._row["rear_impact_mps" if self._row["outcome"] in {"rear", "both"} else "front_impact_mps"]
            first = "rear" if self._row["outcome"] == "both" else self._row["outcome"]
            return f"{OUTCOME_LABELS[first]}: {speed:.1f} m/s"
        if now["phase"] == "acting":
            return f"skill {int(now['skill']) + 1}: {self._texts[int(now['skill'])]}"
        return _PHASES[now["phase"]]


def _frame(panels: list[RoadPanel], at_s: float, foot: str) -> Image:
    from PIL import Image, ImageDraw

    height = len(panels) * (TEXT_HEIGHT + ROAD_HEIGHT) + FOOT_HEIGHT
    frame = Image.new("RGB", (WIDTH, height), _PAPER)
    pen = ImageDraw.Draw(frame)
    for place, panel in enumerate(panels):
        top = place * (TEXT_HEIGHT + ROAD_HEIGHT)
        picture, facts, event, hit = panel.draw(at_s)
        pen.text((8, top + 5), facts, _INK, font=_font(14))
        pen.text((8, top + 25), event, _RED if hit or event.startswith("STALL") else _FAINT, font=_font(14))
        frame.paste(Image.fromarray(picture), (0, top + TEXT_HEIGHT))
    pen.text((8, height - FOOT_HEIGHT + 6), foot, _FAINT, font=_font(11))
    return frame


def _first_impact(path: pd.DataFrame, outcome: str) -> int | None:
    """Return the row of the first impact, or the last row before contact; None without an impact."""
    if outcome == "none":
        return None
    side = "front" if outcome == "front" else "rear"
    touching = path.index[path[f"{side}_gap_m"] <= 0]
    return int(touching[0]) if len(touching) else len(path) - 1


def _headings(path: pd.DataFrame) -> NDArray[np.float64]:
    """Return the ego's heading in rad, positive to the left."""
    along = np.gradient(path["ego_position_m"].to_numpy(dtype="float64")) if len(path) > 1 else np.ones(1)
    aside = np.gradient(path["ego_lateral_m"].to_numpy(dtype="float64")) if len(path) > 1 else np.zeros(1)
    return np.where(np.abs(along) > 1e-6, np.arctan2(aside, np.maximum(along, 1e-6)), 0.0)  # noqa: PLR2004 - at rest


def _font(size: int) -> FreeTypeFont:
    from matplotlib import font_manager
    from PIL import ImageFont

    return ImageFont.truetype(font_manager.findfont("DejaVu Sans Mono" if size > 12 else "DejaVu Sans"), size)  # noqa: PLR2004


def _write_gif(path: Path, frames: list[Image]) -> None:
    """Write a GIF of every second frame: its times are hundredths of a second, and viewers slow down faster ones."""
    from PIL import Image

    ends = np.vstack([np.asarray(frames[place]) for place in (0, -1)])  # the last frame has the colours of an impact
    palette = Image.fromarray(ends).quantize(64)
    shown = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in [*frames[::2], frames[-1]]]
    times = [2000 // FRAMES_A_S] * (len(shown) - 1) + [round(1000 * LAST_S)]
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=times, loop=0, optimize=False)


def _write_film(path: Path, frames: list[Image]) -> None:
    import cv2

    size = frames[0].size
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_A_S, size)
    if not film.isOpened():
        raise OSError("this OpenCV cannot write MP4")
    try:
        for frame in [*frames, *[frames[-1]] * int(LAST_S * FRAMES_A_S)]:
            film.write(np.ascontiguousarray(np.asarray(frame)[..., ::-1]))
    finally:
        film.release()
