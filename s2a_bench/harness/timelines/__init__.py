"""Runs of plans: policies on boards, drawn or live; what is compared, what a model is asked, what policies learn."""
