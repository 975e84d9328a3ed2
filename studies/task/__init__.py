"""What delay costs a task: Meta-World's scripted experts as a policy of chunks, success against latency."""

HORIZON = 24
"""H, actions of a chunk."""
