"""The driving scenario in CARLA."""

EXTRA = "the driving scenario on a CARLA server"
