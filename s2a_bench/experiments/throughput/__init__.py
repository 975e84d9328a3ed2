"""How many tokens a second a model writes, and what lies between them."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="throughput",
    about="Measure tokens a second: prefill, time to first token, every gap between tokens, decode rate by position.",
    config="s2a_bench.experiments.throughput.config:ThroughputConfig",
    run="s2a_bench.experiments.throughput.run:run_throughput",
    view="s2a_bench.experiments.throughput.view:show",
    cell="s2a_bench.experiments.throughput.metrics:ThroughputCell",
    view_options="s2a_bench.experiments.references:AgainstReference",
    compared="s2a_bench.experiments.throughput.metrics:COMPARED",
)
