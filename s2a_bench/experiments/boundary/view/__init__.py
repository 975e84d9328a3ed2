"""How a boundary run is shown: its tables, figure and JSON."""
