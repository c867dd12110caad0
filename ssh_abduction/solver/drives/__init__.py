"""Add new drives to the map of old drives."""
