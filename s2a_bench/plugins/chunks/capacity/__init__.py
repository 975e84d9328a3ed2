"""How many robots one server carries: measured with N control loops, or predicted from the service times of one."""

from s2a_bench.experiments import Experiment, RunMode

EXPERIMENT = Experiment(
    name="capacity",
    about="Find how many robots one server carries, each with its control clock: measured, or predicted.",
    config="s2a_bench.plugins.chunks.capacity.config:CapacityMeasured",
    run="s2a_bench.plugins.chunks.capacity.run:run_measured",
    mode="measured",
    modes=(
        RunMode(
            "predicted",
            "s2a_bench.plugins.chunks.capacity.config:CapacityPredicted",
            "s2a_bench.plugins.chunks.capacity.predict:run_predicted",
            {"predict": ""},
        ),
    ),
    view="s2a_bench.plugins.chunks.capacity.view:show",
    cell="s2a_bench.plugins.chunks.capacity.view:CapacityCell",
    compared="s2a_bench.plugins.chunks.capacity.view:COMPARED",
    unit="fleets",
)
