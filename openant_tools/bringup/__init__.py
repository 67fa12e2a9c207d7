"""The walk from parts to a learning robot: order of steps, what each needs."""
