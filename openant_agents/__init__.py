"""Agents that learn to walk: they know Gymnasium, not robots."""
