"""This machine: checks before measuring, its resources meanwhile, and the facts beside every result."""
