"""Policy servers: the transports and the dialect by which robots ask a policy for a chunk of actions."""
