"""When to act on actions in chunks: modes and triggers under given latencies, in virtual time, or live."""

from s2a_bench.experiments import Experiment, RunMode

EXPERIMENT = Experiment(
    name="chunks",
    about="Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture.",
    config="s2a_bench.plugins.chunks.chunks.config:ChunksVirtual",
    run="s2a_bench.plugins.chunks.chunks.run:run_virtual",
    mode="virtual",
    modes=(
        RunMode(
            "live",
            "s2a_bench.plugins.chunks.chunks.config:ChunksLive",
            "s2a_bench.plugins.chunks.chunks.live:run_live",
            {"live": "act in real time on what a server answers; with --engine echo, --latency is how long it takes"},
        ),
    ),
    view="s2a_bench.plugins.chunks.chunks.view:show",
    cell="s2a_bench.plugins.chunks.chunks.view.tables:ChunkCell",
    unit="cells",
)
