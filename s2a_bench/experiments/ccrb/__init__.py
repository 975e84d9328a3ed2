"""Car-to-car rear braking under each policy: impacts and their speeds."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="ccrb",
    about="Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when.",
    config="s2a_bench.experiments.ccrb.config:CcrbConfig",
    run="s2a_bench.experiments.ccrb.run:run_ccrb",
    view="s2a_bench.experiments.ccrb.view.tables:show",
    cell="s2a_bench.experiments.ccrb.view.tables:CcrbCell",
    unit="parts",
)
