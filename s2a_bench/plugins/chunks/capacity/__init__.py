"""How many robots one server carries: measured with N control loops, or predicted from the service times of one."""

from s2a_bench.experiments import Experiment, RunMode

HERE = "s2a_bench.plugins.chunks.capacity"
EXPERIMENT = Experiment(
    name="capacity",
    about="Find how many robots one server carries, each with its control clock: measured, or predicted.",
    config=f"{HERE}.config:CapacityMeasured",
    run=f"{HERE}.run:run_measured",
    mode="measured",
    modes=(RunMode("predicted", f"{HERE}.config:CapacityPredicted", f"{HERE}.predict:run_predicted", {"predict": ""}),),
    view=f"{HERE}.view:show",
    cell=f"{HERE}.rows:FleetRow",
    compared=f"{HERE}.view:COMPARED",
    unit="fleets",
)
