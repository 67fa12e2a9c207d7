"""Where `openant_tools.effects.robot` was, until the modules that are being written have moved on."""

from __future__ import annotations

from openant_tools.effects.robot import USUAL_NOISE, Cable, Form, Reference, Robot, Seen, tilted

__all__ = ["USUAL_NOISE", "Cable", "Form", "Reference", "Robot", "Seen", "tilted"]
