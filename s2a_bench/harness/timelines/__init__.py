"""Runs of answer plans, drawn or live: their options, the requests for them, and what policies learn."""
