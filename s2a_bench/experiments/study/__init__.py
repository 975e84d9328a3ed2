"""Studies of the policies on drawn plans: targets, jitter, drift, wrong beliefs."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="study",
    about="Study when to act on drawn plans: nothing is measured, everything repeats by its seed.",
    config="s2a_bench.experiments.study.config:StudyConfig",
    run="s2a_bench.experiments.study.run:run_study",
    view="s2a_bench.experiments.study.view:show",
    cell="s2a_bench.experiments.study.view:StudyCell",
    unit="cells",
    commands="study-*",
)
