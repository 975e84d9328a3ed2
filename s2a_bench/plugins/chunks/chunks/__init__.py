"""When to act on actions in chunks: modes and triggers under given latencies, in virtual time, or live."""

from s2a_bench.experiments import Experiment, RunMode
from s2a_bench.plugins.chunks import LIVE

HERE = "s2a_bench.plugins.chunks.chunks"
EXPERIMENT = Experiment(
    name="chunks",
    about="Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture.",
    config=f"{HERE}.config:ChunksVirtual",
    run=f"{HERE}.run:run_virtual",
    mode="virtual",
    modes=(RunMode("live", f"{HERE}.config:ChunksLive", f"{HERE}.live:run_live", LIVE),),
    view=f"{HERE}.view:show",
    cell=f"{HERE}.rows:ChunkCell",
    unit="cells",
)
