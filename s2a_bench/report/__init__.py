"""Reports on runs of all experiments: the page, comparisons, and the paper's claims."""
