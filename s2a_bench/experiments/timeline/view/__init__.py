"""How timelines are shown."""
