"""What each cause by itself looks like: robots that are as the model says but for one cause at one place, and what fits them.

Where several causes act, the strongest hides the others. What is left of a robot once all that the best cause can do at its
place is taken out shows the next one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.features import Floats

__all__ = ["Template", "Templates"]

#: its cause, where that sits, and its coordinates
Template = tuple[str, tuple[int, ...], dict[str, float]]
#: shorter templates do not show
SHOWS = 1e-3
#: of what templates of one place have in common, the share that is taken for noise
NOISE = 1e-3
#: deviations by which a template has to show, to be fitted as it is: what differs by less is noise along any direction
FITS = 1.0


@dataclass(frozen=True)
class Templates:
    """Templates in the measure of healthy robots.

    Attributes:
        bank: what each is of. vectors: (templates, features).
    """

    bank: tuple[Template, ...]
    vectors: Floats

    @classmethod
    def of(cls, bank: Sequence[Template], vectors: Floats) -> Templates:
        """Those that show at all."""
        seen = np.linalg.norm(vectors, axis=1) > SHOWS
        return cls(tuple(one for one, shows in zip(bank, seen, strict=True) if shows), vectors[seen])

    @cached_property
    def causes(self) -> tuple[str, ...]:
        return tuple(sorted({name for name, _, _ in self.bank}))

    @cached_property
    def _unit(self) -> Floats:
        out: Floats = self.vectors / np.maximum(np.linalg.norm(self.vectors, axis=1, keepdims=True), FITS)
        return out

    @cached_property
    def of_cause(self) -> list[NDArray[np.int64]]:
        names = np.array([name for name, _, _ in self.bank])
        return [np.flatnonzero(names == cause) for cause in self.causes]

    @cached_property
    def _same_place(self) -> list[NDArray[np.int64]]:
        """Of each template, those of the same cause at the same place."""
        groups: dict[tuple[str, tuple[int, ...]], list[int]] = {}
        for k, (name, where, _) in enumerate(self.bank):
            groups.setdefault((name, where), []).append(k)
        return [np.array(groups[name, where]) for name, where, _ in self.bank]

    def fits(self, z: Floats) -> Floats:
        """(robots, templates) how far whitened differences go along each template, none backwards."""
        out: Floats = np.maximum(z @ self._unit.T, 0.0)
        return out

    def without_best(self, z: Floats, times: int) -> Floats:
        """(features,) what is left of one robot's differences once the causes that fit best are taken out, one after another."""
        left = z.astype(np.float64)
        for _ in range(times):
            mine = self._same_place[int((self._unit @ left).argmax())]
            unit = self._unit[mine].astype(np.float64)
            left = left - np.linalg.solve(unit @ unit.T + NOISE * np.eye(len(mine)), unit @ left) @ unit
        return left.astype(np.float32)
