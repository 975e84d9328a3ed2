"""Compare two runs, or two sets of launches."""
