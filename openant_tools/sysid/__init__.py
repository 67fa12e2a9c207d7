"""System identification: excitation, fitting, verdicts, the calibrated MJCF."""
