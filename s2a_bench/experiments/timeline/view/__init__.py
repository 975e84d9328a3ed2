"""How a timeline run is shown: its cells, tables, figures, traces and JSON."""
