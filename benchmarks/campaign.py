"""One attack, tried many times, and how often the toolkit withstood it: a row of docs/reliability.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Campaign"]


@dataclass(frozen=True)
class Campaign:
    """An attack that can be tried again and again.

    Attributes:
        attack: what is done to the toolkit, in a builder's words, and what counts as withstood.
        tries: how often it is tried by default.
        run: makes try number k (for its random numbers) and says whether it was withstood.
    """

    attack: str
    tries: int
    run: Callable[[int], bool]
