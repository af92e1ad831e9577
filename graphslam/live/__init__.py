"""Estimates while a robot drives: messages as they come, a recording while it is written."""
