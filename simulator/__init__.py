"""Worlds and robots whose true map is known, to make traces and logs.

- `world`: worlds with walls, clutter, places and a route, and their files.
- `plans`, `occupancy`: worlds from floor plans and from occupancy maps of ROS.
- `tours`, `rounds`: drive through a world, and log what the robot sees.
- `driver`, `junctions`: the control laws of the robot. They see laser images, and no true pose.

Import from the modules. The package itself exports nothing, so that no command loads what it does
not need.
"""
