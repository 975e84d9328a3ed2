"""The experiment ``latency``: the time that each transport adds between a frame and its first token."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="latency",
    about="Measure what the transport costs: HTTP/JSON + Base64 against ROS 2-native, every stage, one interleaved "
    "run.",
    config="s2a_bench.experiments.latency.config:LatencyConfig",
    run="s2a_bench.experiments.latency.run:run_latency",
    view="s2a_bench.experiments.latency.view:show",
    cell="s2a_bench.experiments.latency.metrics:LatencyCell",
    view_options="s2a_bench.experiments.references:AgainstReference",
    compared="s2a_bench.experiments.latency.metrics:COMPARED",
)
