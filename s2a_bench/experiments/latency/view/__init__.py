"""How a latency run is shown: its cells, tables, figures, CSV and JSON."""
