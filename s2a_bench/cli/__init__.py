"""One module per command: parse, compose, print, exit code; nothing else."""
