"""From parameters to residuals: what the model does with each u on all runs, and how that changes with each parameter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import effect
from openant_tools.model.plant import Setup
from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.parameter import Parameter, colours
from openant_tools.sysid.solve import Derive, Movers, Point, Tangent

__all__ = ["STEP", "ForwardModel"]

Array = NDArray[np.float64]

#: finite-difference step in prior deviations: far above rounding and the solver's tolerance, and small enough that two
#: parameters which move a robot alike have columns alike (at 0.1 their curvature told them apart)
STEP = 0.03
#: on the floor contacts chatter, and small differences are that: of joints, and of what belongs to body and floor
FLOOR_STEP, FLOOR_STEP_OF_BODY = 0.1, 0.6


class ForwardModel:
    """Simulations of all runs.

    Args:
        datasets: all with the same joints in the same order.
        parameters: the unknowns.

    Attributes:
        on_floor: whether contacts chatter.
        coarse: whether there are long time steps.
        differences: (parameters,) finite-difference steps, in prior deviations.
        low, high: (parameters,) the physical bounds of u.
        evaluations: variants that were simulated so far.
    """

    def __init__(self, datasets: Sequence[Dataset], parameters: Sequence[Parameter]) -> None:
        self.datasets, self.parameters, self.evaluations = datasets, parameters, 0
        self.on_floor = any(data.plant.setup is Setup.FLOOR for data in datasets)
        self.coarse = any(data.coarse is not data for data in datasets)
        chattering = [FLOOR_STEP_OF_BODY if p.definition.body else FLOOR_STEP for p in parameters]
        self.differences: Array = np.array(chattering if self.on_floor else [STEP] * len(parameters))
        shared = any(effect(name).shared for data in datasets for name, _ in data.acting)
        self._colours = colours(datasets[0].plant, parameters, coupled=self.on_floor or shared)
        self._movers = self._find_movers()
        self.low, self.high = _bounds(datasets, parameters)

    def look(self, us: Sequence[Array]) -> list[Point]:
        """What each u leaves: (rows, joints) measured minus simulated, rad, NaN where missing; and its speed, rad/s."""
        self.evaluations += len(us)
        made = [data.simulate(self.parameters, us) for data in self.datasets]
        left = [data.measured - one.pos for data, one in zip(self.datasets, made, strict=True)]
        residual, velocity = np.concatenate(left, axis=1), np.concatenate([one.vel for one in made], axis=1)
        return [Point(*found) for found in zip(us, residual, velocity, strict=True)]

    def derive(self, asked: Sequence[Derive]) -> list[Tangent]:
        """Derivatives by differences, those that are stepped alike in one batch."""
        n = len(self._colours)
        out = [
            Tangent(one.point.u, self._movers, np.zeros((n, *one.point.residual.shape), np.float32)) for one in asked
        ]
        for coarse in {one.coarse for one in asked}:
            alike = [k for k, one in enumerate(asked) if one.coarse == coarse]
            self._difference([asked[k] for k in alike], [out[k] for k in alike], coarse)
        for one, tangent in zip(asked, out, strict=True):
            tangent.change[:, ~np.isfinite(one.point.residual)] = 0.0
        return out

    def _difference(self, asked: Sequence[Derive], tangents: Sequence[Tangent], coarse: bool) -> None:
        n, us = len(self._colours), list[Array]()
        places, apart = [], []
        for one in asked:
            variants, between = self._variants(one)
            places.append(slice(len(us), len(us) + len(variants)))
            us += variants
            apart.append(between)
        self.evaluations += len(us)
        begin = 0
        for data in self.datasets:
            for rows, pos, _ in (data.coarse if coarse else data).stream(self.parameters, us):
                here = slice(rows.start + begin, rows.stop + begin)
                for one, tangent, place, between in zip(asked, tangents, places, apart, strict=True):
                    found, others = pos[place][:n], pos[place][n:]
                    base = others if len(others) else (data.measured[rows] - one.point.residual[here])[None]
                    # The residual is measured minus simulated, so that it falls as the position rises.
                    tangent.change[:, here] = np.nan_to_num((base - found) / between[:, None, :])
            begin += len(data.measured)

    def _variants(self, asked: Derive) -> tuple[list[Array], Array]:
        """What to simulate, a colour each and then what that differs from; and how far apart, (colours, joints)."""
        # Forward where the bound allows, else backward; where both, the other side too.
        u, by = asked.point.u, self.differences
        up, down = u + by <= self.high, u - by >= self.low
        ahead = np.where(up, by, -by)
        behind = np.where(up & down, -by, 0.0) if asked.central else np.zeros(len(u))
        variants = []
        for step in (ahead, behind) if asked.central else (ahead,):
            for members, _ in self._colours:
                moved = u.copy()
                moved[members] += step[members]
                variants.append(moved)
        if asked.coarse and not asked.central:
            variants.append(u)  # what both differ from must be stepped alike
        apart = np.ones((len(self._colours), asked.point.residual.shape[1]))
        for c, (members, masks) in enumerate(self._colours):
            for p, affected in zip(members, masks, strict=True):
                apart[c, affected] = ahead[p] - behind[p]
        return variants, apart

    def _find_movers(self) -> Movers:
        """For each joint, the parameters that move it and their colours."""
        out = []
        for j in range(len(self.datasets[0].plant.joints)):
            pairs = [
                (p, c)
                for c, (members, masks) in enumerate(self._colours)
                for p, mask in zip(members, masks, strict=True)
                if mask[j]
            ]
            out.append((np.array([p for p, _ in pairs], np.int64), np.array([c for _, c in pairs], np.int64)))
        return out


def _bounds(datasets: Sequence[Dataset], parameters: Sequence[Parameter]) -> tuple[Array, Array]:
    """(parameters,) of u, between which every joint of every model stays physical."""
    low, high = [], []
    for parameter in parameters:
        kind = parameter.definition
        ends = [
            parameter.bounds(kind.read(data.plant.model, data.plant, j))
            for data in datasets
            if parameter.belongs(data.plant)
            for j in parameter.joints
        ]
        # Of a gain whose runs are all left out nothing is known but its prior.
        low.append(max((end[0] for end in ends), default=-np.inf))
        high.append(min((end[1] for end in ends), default=np.inf))
    return np.array(low), np.array(high)
