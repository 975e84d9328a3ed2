"""Studies of the policies on drawn plans: targets, jitter, drift, wrong beliefs."""
