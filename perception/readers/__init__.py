"""Readers and writers of robot logs: CARMEN, g2o, bags of ROS 1 and 2, MCAP and poses."""
