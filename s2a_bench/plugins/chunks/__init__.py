"""Acting on chunks of actions: acting modes, the control loop, the experiments ``chunks`` and ``capacity``.

``modes`` decides which action a control tick executes, in virtual time; ``control`` does the same on a clock.
``latencies`` has the delays that both experiments draw from, ``requester`` asks a server for chunks. docs/chunks.md,
docs/capacity.md.
"""
