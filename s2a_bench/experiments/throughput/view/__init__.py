"""How a throughput run is shown: its cells, tables, figures and JSON."""
