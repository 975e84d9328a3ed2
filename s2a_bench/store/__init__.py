"""Run folders: manifest, environment and raw samples; appended to, never overwritten."""
