"""Learn how well sizes of causes are known, from robots that were diagnosed and whose answers are open.

    python -m benchmarks.gap_training.sizes SET… [--key-file KEY…] [--keep benchmarks/gap_training/sizes.json] [--out openant_tools/gap]

What was found and what is true of each coordinate goes into one small file (`--keep`), which may be named in the sets' place. Of each set is printed how many of its values lie between the ends by what the others alone teach. Nothing is simulated.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.gap_training.decision import short
from openant_tools.blind.answers import read_answers
from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Quantity
from openant_tools.files import json_text, read_toml, write_text
from openant_tools.gap.descent import SPREAD
from openant_tools.gap.size_interval import FILE, FREEDOM, KINDS, Known, ends, spread
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.virtual.seal import read_key

#: what the search begins with: off by half, as logarithms go
START = 0.5
#: of what is true that is to lie between the ends
SHARE = 0.95


class Value(NamedTuple):
    """One coordinate of a cause that was named and is there. `true` is what it is, the others as of `Known`."""

    effect: str
    quantity: str
    x: float
    largest: float
    std: float
    tolerance: float
    support: float | None
    true: float

    @property
    def known(self) -> Known:
        return Known(self.x, self.largest, self.std, self.tolerance, self.support)

    @property
    def of(self) -> Quantity:
        return catalogue()[self.effect].quantity(self.quantity)


def kept(path: Path) -> dict[str, list[Value]]:
    """What was kept of sets."""
    return {name: [Value(*row) for row in rows] for name, rows in json.loads(path.read_text()).items()}


def values(path: Path, key: bytes | None) -> list[Value]:
    """Of a set that was diagnosed."""
    answers = read_answers(path, key, str(read_toml(path / "set.toml")["commitment"]))
    return [
        value
        for verdict in sorted((path / "verdicts").glob("*.json"))
        for value in _of_robot(json.loads(verdict.read_text()), answers[verdict.stem].as_table())
    ]


def _of_robot(found: Mapping[str, Any], truth: Mapping[str, Any]) -> Iterator[Value]:
    true = {one["effect"]: one["parameters"] for one in truth.get("effect", [])}
    rows = {row["causes"][0]: row for row in found["rows"] if len(row["causes"]) == 1}
    for one in found["effects"]:
        name = one["effect"]
        if name not in found["selected"] or name not in true or name not in rows:
            continue
        effect, x = catalogue()[name], one["coordinates"]
        joints = len(one["joints"]) if isinstance(one["joints"], list) else len(JOINT_NAMES)
        for q in effect.quantities:
            said, is_true = one["parameters"].get(q.name), true[name].get(q.name)
            if said is None or said["high"] is None or not isinstance(is_true, int | float) or abs(x[q.name]) < 1e-9:
                continue  # stated otherwise than it is fitted, or none
            scale = _scale(q, x[q.name], said["value"])
            away = [abs(q.back(said[end], scale) - x[q.name]) for end in ("low", "high") if said[end] != said["value"]]
            std = max(away, default=0.0) / 1.96
            support = None if effect.random else rows[name]["support"] or 0.0
            known = Known.of(q, x, effect.quantities, std, q.tolerance / scale, support, joints)
            yield Value(
                name, q.name, known.x, known.largest, known.std, known.tolerance, known.support, q.back(is_true, scale)
            )


def _scale(q: Quantity, x: float, value: float) -> float:
    """What a coordinate of 1 means on that robot."""
    if math.isclose(q.value(1.0, 2.0), q.value(1.0, 1.0)):
        return 1.0  # a factor, or a shape
    return (
        value / x if q.value(1.0, 2.0) == 2 * q.value(1.0, 1.0) and q.value(2.0, 1.0) > q.value(1.0, 1.0) else value * x
    )


def learned(some: Sequence[Value]) -> dict[str, float]:
    """Spreads under which what is true surprises least (Student's t), with tolerances and what fits say of themselves."""

    def surprise(logarithms: NDArray[np.float64]) -> float:
        at = dict(zip(KINDS, np.exp(logarithms).tolist(), strict=True))
        whole = float(np.square(logarithms - math.log(START)).sum())
        for one in some:
            known, size = one.known, max(abs(one.x), one.largest)
            if one.of.shape:
                off, by = math.log(one.true / one.x), spread(one.of, known, at)
            else:
                off = math.asinh((one.true - one.x) / size)
                by = math.hypot(spread(one.of, known, at), known.std / size, SPREAD * known.tolerance / size)
            whole += math.log(by) + (FREEDOM + 1) / 2 * math.log1p((off / by) ** 2 / FREEDOM)
        return whole

    found = np.exp(minimize(surprise, np.full(len(KINDS), math.log(START)), method="Nelder-Mead").x)

    def between(factor: float) -> dict[str, float]:
        return dict(zip(KINDS, (factor * found).tolist(), strict=True))

    # As much wider as it takes: 95 % is what the ends promise.
    return next(by for factor in np.arange(1.0, 5.0, 0.05) if np.mean(inside(some, by := between(factor))) >= SHARE)


def inside(some: Sequence[Value], by: Mapping[str, float] | None) -> list[bool]:
    """Whether what is true lies between the ends; None: between those of the fit's own deviations."""
    out = []
    for one in some:
        low, high = (one.x - 1.96 * one.std, one.x + 1.96 * one.std) if by is None else ends(one.of, one.known, by)
        out.append(low <= one.true <= high)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument("--key-file", type=Path, action="append", default=[], help="of each set, in order")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.key_file and len(options.key_file) != len(options.sets):
        parser.error("name a key for each set, or none")
    keys: list[bytes | None] = [read_key(path) for path in options.key_file] or [None] * len(options.sets)
    sets = dict[str, list[Value]]()
    for path, key in zip(options.sets, keys, strict=True):
        sets |= kept(path) if path.is_file() else {path.name: values(path, key)}
    for name, some in sets.items():
        others = learned([one for other, theirs in sets.items() if other != name for one in theirs])
        own, by_others = inside(some, None), inside(some, others)
        print(
            f"{name}: {sum(own)} of {len(own)} by fits, {sum(by_others)} of {len(by_others)} by what the others teach"
        )
    found = {name: short(value) for name, value in learned([one for some in sets.values() for one in some]).items()}
    print(found)
    if options.keep:
        rows = {
            name: [[short(v) if isinstance(v, float) else v for v in one] for one in some]
            for name, some in sets.items()
        }
        lines = [f'"{name}": [\n' + ",\n".join(map(json.dumps, of)) + "\n]" for name, of in rows.items()]
        write_text(options.keep, "{\n" + ",\n".join(lines) + "\n}\n")
    if options.out:
        write_text(options.out / FILE, json_text(found))


if __name__ == "__main__":
    main()
