"""How many of a model's skills are valid, with a grammar and without."""
