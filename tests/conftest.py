"""Settings of all tests."""

from hypothesis import HealthCheck, settings

# How fast the machine is decides nothing: not whether an example takes too long, nor whether it takes too long to draw one. And the examples are the same in each
# run: of traces at random, some take clingo a hundred times as long as others.
settings.register_profile("the same everywhere", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("the same everywhere")
