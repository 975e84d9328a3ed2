"""Chunks live: a control loop that acts on what a server answers, over any transport."""
