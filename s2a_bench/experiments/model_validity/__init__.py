"""How many of a model's skills are valid, with a grammar and without."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="model validity",
    about="Count the valid skills in a model's plans, with a grammar and without (the paper's hallucination control).",
    config="s2a_bench.experiments.model_validity.config:ValidityConfig",
    run="s2a_bench.experiments.model_validity.run:run_validity",
    view="s2a_bench.experiments.model_validity.view:show",
    cell="s2a_bench.experiments.model_validity.cell:ValidityCell",
    unit="answers",
)
