"""The example of a plug-in for s2a-bench: a transport, a dialect, a frame source, a policy and an experiment."""
