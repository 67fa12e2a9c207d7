"""Gymnasium environments of the Open Ant, simulated and real, built from one robot folder."""
