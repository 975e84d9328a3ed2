"""Hardware profiles: boards, their files and where they are found; families of gaps between tokens, and fitting."""
