"""The example of a plug-in for s2a-bench: one of each kind that no plug-in of its own adds, and a transport."""
