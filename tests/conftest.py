"""What all tests share."""

import os

from hypothesis import settings

from graphslam.cli import THREADS

# linear algebra with one thread, as the commands use it: sums in another order have other last
# digits, and results are compared by the byte. Before anything imports NumPy.
for name in THREADS:
    os.environ.setdefault(name, "1")

# a machine that is busy with something else must not fail a property for its time
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
