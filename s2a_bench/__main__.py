"""Run the command line with ``python -m s2a_bench``."""

from s2a_bench.cli import main

main()
