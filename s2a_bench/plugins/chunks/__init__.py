"""Acting on chunks of actions: acting modes, the control loop, the experiments ``chunks`` and ``capacity``.

``modes`` decides which action a control tick executes, in virtual time; ``control`` does the same on a clock.
``latencies`` has the delays that both experiments draw from, ``requester`` asks a server for chunks. docs/chunks.md,
docs/capacity.md.
"""

LIVE = {"live": "act in real time on what a server answers; with --engine echo, --latency is how long that takes"}
"""The option that chooses the run mode ``live``, and its help."""
