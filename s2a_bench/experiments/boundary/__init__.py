"""Where naive execution is stall-free, over tokens per skill and rate."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="boundary",
    about="Show at which rates and granularities naive execution never stalls: by formula, and by trying every point.",
    config="s2a_bench.experiments.boundary.config:BoundaryConfig",
    run="s2a_bench.experiments.boundary.run:run_boundary",
    view="s2a_bench.experiments.boundary.view:show",
    cell="s2a_bench.experiments.boundary.rows:BoundaryCell",
    unit="points",
)
