"""The effect catalogue: one module an effect, registered by being there (`catalogue`)."""
