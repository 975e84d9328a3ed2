"""When to act on actions in chunks: modes and triggers under given latencies, in virtual time, or live."""

from s2a_bench.experiments import Experiment

EXPERIMENT = Experiment(
    name="chunks",
    about="Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture.",
    config="s2a_bench.plugins.chunks.chunks.config:ChunksConfig",
    run="s2a_bench.plugins.chunks.chunks.run:run_chunks",
    view="s2a_bench.plugins.chunks.chunks.view:show",
    cell="s2a_bench.plugins.chunks.chunks.view.tables:ChunkCell",
    unit="cells",
)
