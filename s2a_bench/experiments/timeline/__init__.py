"""When each policy acts, and where it stalls: in virtual time, in real time, or on a model's live stream."""
