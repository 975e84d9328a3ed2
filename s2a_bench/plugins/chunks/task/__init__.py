"""The experiment ``task``: success against latency, in virtual time or live."""

from s2a_bench.experiments import Experiment, RunMode
from s2a_bench.plugins.chunks import LIVE

HERE = "s2a_bench.plugins.chunks.task"
EXPERIMENT = Experiment(
    name="task",
    about="Show what delay costs a task: success of a policy in a world against latency, computed or live.",
    config=f"{HERE}.config:TaskVirtual",
    run=f"{HERE}.virtual:run_virtual",
    mode="virtual",
    modes=(RunMode("live", f"{HERE}.config:TaskLive", f"{HERE}.live:run_live", LIVE),),
    view=f"{HERE}.view:show",
    cell=f"{HERE}.rows:TaskCell",
    compared=f"{HERE}.rows:COMPARED",
    unit="episodes",
)
