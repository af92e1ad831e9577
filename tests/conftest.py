"""What all tests share."""

from hypothesis import settings

# a machine that is busy with something else must not fail a property for its time
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
