"""Places: from the scans and the odometry of a log to visits, gateways and closures."""
