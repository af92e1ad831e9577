"""Logs of sightings solved as a whole: states, noise, association, all robots at once."""
