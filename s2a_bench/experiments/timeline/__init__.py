"""What each policy makes of streamed skills: computed, played in real time, or live."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="timeline",
    about="Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live.",
    config="s2a_bench.harness.timelines.config:TimelineConfig",
    run="s2a_bench.experiments.timeline.run:run_timeline",
    view="s2a_bench.experiments.timeline.view.tables:show",
    cell="s2a_bench.experiments.timeline.view.cells:TimelineCell",
    compared="s2a_bench.experiments.timeline.view.cells:COMPARED",
    unit="timelines",
)
