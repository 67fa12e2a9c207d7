"""Bring-up procedures: each takes a robot from one proven state to the next."""
