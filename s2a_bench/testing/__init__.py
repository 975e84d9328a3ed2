"""What the author of a plug-in needs: one suite a seam, run by every implementation of ours too."""
