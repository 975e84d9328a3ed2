"""Where naive execution is stall-free, over tokens per skill and rate."""
