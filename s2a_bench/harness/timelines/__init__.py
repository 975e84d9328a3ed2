"""Runs of plans, drawn or live: their options, the requests for plans, and the knowledge of policies."""
