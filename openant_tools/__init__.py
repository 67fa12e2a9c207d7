"""Open Ant Tools: from a box of parts to a robot that learns, and a simulation of it that can be trusted."""
