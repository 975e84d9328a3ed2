"""Acting: an executor carries a policy's decisions out on a clock."""
