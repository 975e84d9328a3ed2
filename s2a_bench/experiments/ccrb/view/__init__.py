"""How a CCRB run is shown."""
