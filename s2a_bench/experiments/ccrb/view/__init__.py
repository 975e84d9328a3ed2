"""How a CCRB run is shown: its outcomes, tables, figures, animation and JSON."""
