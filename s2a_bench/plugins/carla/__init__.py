"""The driving scenario in CARLA."""
