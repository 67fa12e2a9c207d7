"""How evidence weighs: boosted trees over rows of evidence, taught once on robots of many kinds, as plain arrays.

Which cause a row is of enters as one of its columns. What was taught, on how many robots, and how well it does on experiments that
it had not seen: benchmarks/gap_training, docs/gap.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.arrays import read_arrays
from openant_tools.gap.features import Floats

__all__ = ["Classifier", "classifier", "weights"]

Ints = NDArray[np.int32]

#: the files in this package
FILE, WEIGHTS_FILE = "classifier.npz", "posterior.json"
#: a node that is a leaf
LEAF = -1


@dataclass(frozen=True)
class Classifier:
    """Trees, node by node.

    Attributes:
        start: log-odds before any tree.
        root: (trees,) the first node of each.
        column: (nodes,) which is compared, LEAF where none is.
        threshold: (nodes,) go left where the column is not larger.
        left, right: (nodes,) where on.
        value: (nodes,) log-odds of a leaf.
    """

    start: float
    root: Ints
    column: NDArray[np.int16]
    threshold: Floats
    left: Ints
    right: Ints
    value: Floats

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Classifier:
        parts = (arrays[name] for name in ("root", "column", "threshold", "left", "right", "value"))
        return cls(float(arrays["start"][0]), *parts)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """As `of` takes them."""
        return {**vars(self), "start": np.array([self.start])}

    def __call__(self, rows: Floats) -> Floats:
        """Log-odds that a robot has the cause, for rows of any shape (…, columns)."""
        flat = rows.reshape(-1, rows.shape[-1])
        index, total = np.arange(len(flat)), np.full(len(flat), self.start)
        for root in self.root:
            node = np.full(len(flat), root)
            while (inner := self.column[node] != LEAF).any():
                at = node[inner]
                lower = flat[index[inner], self.column[at]] <= self.threshold[at]
                node[inner] = np.where(lower, self.left[at], self.right[at])
            total += self.value[node]
        out: Floats = total.reshape(rows.shape[:-1]).astype(np.float32)
        return out


@cache
def weights() -> Mapping[str, float]:
    """Those of `gap.posterior` that were learned with it."""
    text = json.loads((files("openant_tools.gap") / WEIGHTS_FILE).read_text())
    return {str(name): float(value) for name, value in text.items()}


@cache
def classifier() -> Classifier:
    """The one that comes with the package."""
    with as_file(files("openant_tools.gap") / FILE) as path:
        return Classifier.of(read_arrays(path))
