"""Where `openant_tools.effects.effect` and `effects.catalogue` were, until the modules that are being written have moved on."""

from __future__ import annotations

from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.effect import Cause, Quantity, Scope, Values

__all__ = ["Cause", "Quantity", "Scope", "Values", "catalogue", "enter"]
