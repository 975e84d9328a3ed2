"""What is kept: run folders with manifest, environment and raw samples; append, never overwrite."""
