"""What this machine is: checks before measuring, what it does meanwhile, and the facts beside every result."""
