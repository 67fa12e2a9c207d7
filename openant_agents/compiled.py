"""Functions as machine code, for what acting and deciding do thousands of times over."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

__all__ = ["compiled", "compiled_sums"]

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code (Numba), made when it is first called and kept on the disk from then on.

    The first call takes seconds: whoever uses it in a control loop calls it once before.
    """
    return cast(Callable[P, R], numba.njit(cache=True)(function))


def compiled_sums(function: Callable[P, R]) -> Callable[P, R]:
    """`compiled`, where sums may be taken in any order: several numbers at once, rounded differently."""
    return cast(Callable[P, R], numba.njit(cache=True, fastmath={"reassoc", "contract"})(function))
