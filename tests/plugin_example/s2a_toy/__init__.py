"""The example of a plug-in for s2a-bench: one of each kind, a transport, a dialect, an engine and so on."""
