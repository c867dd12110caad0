"""The answer for one trace as plain values, their JSON and their words."""
