"""How many robots one server carries: measured with N control loops, or predicted from the service times of one."""
