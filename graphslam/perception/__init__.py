"""From one laser scan to observations: front ends, robot outlines, scan matching."""
