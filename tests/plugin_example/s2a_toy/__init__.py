"""The example of a plug-in for s2a-bench: one of each kind, a transport, a dialect, an engine and so on."""

HELLO = ("s2a_toy.hello:hello", "Greet somebody.")
"""The command `toy-hello`; for every --help this module is read, and imports nothing."""
