"""The experiment `toy-clock`: what reading the clock costs. Its declaration; light to import."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="toy-clock",
    about="Measure what one reading of the clock costs.",
    config="s2a_toy.clock_run:ClockConfig",
    run="s2a_toy.clock_run:run_clock",
    view="s2a_toy.clock_view:show",
    compared="s2a_toy.clock_view:COMPARED",
    unit="readings",
)
