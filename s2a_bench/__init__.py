"""Measure how a vision-language model is wired to a robot, stage by stage."""

__version__ = "0.1.0"
