"""`s2a-bench demo`: a short run for each question, one page of both, and what to read off it."""

from __future__ import annotations

import os
import shlex
import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import print_error, print_failures, print_line
from s2a_bench.errors import S2AError
from s2a_bench.inference import STAND_IN
from s2a_bench.options import Options, option
from s2a_bench.report.page import ReportConfig
from s2a_bench.transport import RAW
from s2a_bench.transport.defaults import COMPARED, LOOPBACK

RUNS: Final[dict[str, dict[str, Any]]] = {
    "latency": {"transports": (*COMPARED, LOOPBACK), "engine": STAND_IN, "payload": (RAW,), "requests": 100},
    "timeline": {"tokens_per_skill": (6,)},
}
"""The options of each experiment: no model is loaded, and the timelines are computed."""
FIGURES: Final = ("stages", "timeline")  # on the page, one of each experiment
QUESTIONS: Final = {
    "latency": "What transports cost, measured here without a model:",
    "timeline": "When the robot may act, EMULATED after the paper's boards (computed, so there is no interval):",
}
NEXT: Final = (
    "s2a-bench latency --url http://127.0.0.1:8000    # a server that runs already",
    "s2a-bench timeline --rate 10 --jitter lognormal:cv=0.2    # the tokens/s of your model",
)


class DemoConfig(Options):
    output: Path = option(Path("results"), "folder for run folders and the page, demo.html")
    no_open: bool = option(False, "do not open the page in a browser")


def _demo(config: DemoConfig) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.library import run
    from s2a_bench.report.page.chapters import read_chapters
    from s2a_bench.report.page.files import make_report, write_report

    page = config.output / "demo.html"
    to_page = ReportConfig(runs=[], output=page)  # raises UsageError before anything is measured
    folders: list[Path] = []
    progress = RunProgress()
    try:
        for name, options in RUNS.items():
            with RunProgress() as progress:
                folders.append(run(name, output=config.output, progress=progress, **options).path)
        chapters = read_chapters(folders)
        for place, chapter in enumerate(chapters):
            figures = {name: draw for name, draw in chapter.content.figures.items() if name in FIGURES}
            chapters[place] = replace(chapter, content=replace(chapter.content, figures=figures))
        write_report(make_report(chapters), to_page)
    except (S2AError, KeyboardInterrupt):
        paths = dict.fromkeys((*folders, progress.folder))
        if kept := [str(folder) for folder in paths if folder and folder.exists()]:
            progress.say(f"what was measured so far: {shlex.join(['s2a-bench', 'report', *kept])}")
        raise
    for chapter in chapters:
        for warning in chapter.run.manifest["warnings"]:
            print_error(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}")
        print_line(QUESTIONS[str(chapter.run.manifest["command"])])
        for sentence in chapter.content.sentences:
            print_line(f"  {sentence}")
    for line in (f"Page: {page}", "Next:", *(f"  {line}" for line in NEXT)):
        print_line(line)
    if not config.no_open and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())
    print_failures(*((chapter.run.path, chapter.content.failures) for chapter in chapters))


demo = command(_demo, DemoConfig)
