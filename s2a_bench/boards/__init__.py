"""Hardware profiles: what a board is, the families of its gaps, its file, where files are found, and fitting."""
