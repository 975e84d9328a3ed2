"""What each policy makes of streamed skills: computed, played in real time, or live."""

from s2a_bench.experiments import Experiment, RunMode

EXPERIMENT = Experiment(
    name="timeline",
    about="Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live.",
    config="s2a_bench.experiments.timeline.config:TimelineComputed",
    run="s2a_bench.experiments.timeline.run:run_computed",
    mode="computed",
    modes=(
        RunMode(
            "real-time",
            "s2a_bench.experiments.timeline.config:TimelineRealTime",
            "s2a_bench.experiments.timeline.run:run_real_time",
            {"real_time": "play the boards' tokens on the clock and execute while you watch"},
        ),
        RunMode(
            "live",
            "s2a_bench.experiments.timeline.config:TimelineLive",
            "s2a_bench.experiments.timeline.live:run_live",
            {"live": "execute a model's real answers as they arrive"},
        ),
    ),
    view="s2a_bench.experiments.timeline.view.tables:show",
    cell="s2a_bench.experiments.timeline.view.cells:TimelineCell",
    compared="s2a_bench.experiments.timeline.view.cells:COMPARED",
    unit="timelines",
)
