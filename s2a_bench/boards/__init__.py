"""Hardware profiles: what a board is, its file, where files are found; the families of its gaps, and fitting."""
