"""How it is shown: tables and figures, made from what the store holds; never measures."""
