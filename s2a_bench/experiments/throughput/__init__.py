"""How many tokens a second a model writes, in this process, over transports, and beside llama-bench."""
