"""Which landmark an observation is of, and where a robot has been before.

Gating, data association, the life cycle of landmarks, submaps, loop closure and its verification,
duplicate landmarks.
"""
