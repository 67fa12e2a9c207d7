"""The effects that are here: every module of this package with an `EFFECT`."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from functools import cache

from openant_tools import effects
from openant_tools.effects.effect import Effect
from openant_tools.errors import BadInput

__all__ = ["catalogue", "effect"]


@cache
def catalogue() -> dict[str, Effect]:
    """Name → effect."""
    found = {}
    for module in pkgutil.iter_modules(effects.__path__):
        one = getattr(importlib.import_module(f"{effects.__name__}.{module.name}"), "EFFECT", None)
        if isinstance(one, Effect):
            found[one.name] = one
    return found


def effect(name: str) -> Effect:
    """The effect of that name.

    Raises:
        BadInput: there is none.
    """
    known = catalogue()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        remedy = f"did you mean {near[0]!r}?" if near else f"these act between steps: {', '.join(sorted(known))}"
        raise BadInput(f"no effect is called {name!r}", remedy=remedy)
    return known[name]
