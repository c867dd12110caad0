"""Settings of all tests."""

from hypothesis import HealthCheck, settings

# How fast the machine is decides nothing: not whether an example takes too long, nor whether it takes too long to draw one.
settings.register_profile("of any speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("of any speed")
