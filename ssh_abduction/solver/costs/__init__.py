"""Find maps of least cost in nats, and prove lower bounds on the cost of all maps."""
