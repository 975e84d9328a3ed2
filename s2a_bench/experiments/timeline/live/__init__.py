"""Timelines on the stream of a model that answers."""
