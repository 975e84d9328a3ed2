"""How a study is shown: its tables, figures and JSON."""
