"""Reports on runs of all experiments: the page, comparisons, and verdicts on claims."""
