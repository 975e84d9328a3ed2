"""The experiment ``timeline``: streamed skills under each policy, computed, played in real time, or live."""

from s2a_bench.experiments import Experiment, RunMode

HERE = "s2a_bench.experiments.timeline"
PLAYED = "play the boards' tokens on the clock and execute while you watch"
ANSWERED = "execute a model's real answers as they arrive"

EXPERIMENT = Experiment(
    name="timeline",
    about="Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live.",
    config=f"{HERE}.config:TimelineComputed",
    run=f"{HERE}.run:run_timeline",
    mode="computed",
    modes=(
        RunMode("real-time", f"{HERE}.config:TimelineRealTime", f"{HERE}.run:run_real_time", {"real_time": PLAYED}),
        RunMode("live", f"{HERE}.config:TimelineLive", f"{HERE}.live:run_live", {"live": ANSWERED}),
    ),
    view=f"{HERE}.view.tables:show",
    cell=f"{HERE}.rows:TimelineCell",
    compared=f"{HERE}.view.cells:COMPARED",
    unit="timelines",
)
