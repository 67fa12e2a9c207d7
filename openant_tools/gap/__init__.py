"""The gap between a robot and its simulation: how large it is, and where it lies."""
