"""Learn how the decision weighs evidence against held-out data, from robots that were diagnosed and whose answers are open.

    openant gap blind make --out SET --seed 1 --open …; openant gap blind run SET
    python -m benchmarks.gap_training.decision SET… [--keep benchmarks/gap_training/judged] [--out openant_tools/gap]

What a diagnosis decided on stands in its JSON (`rows`), so that nothing is simulated here; `--keep` writes that of each set into one small
file, which may be named in the set's place. Sets of several makers are named together, and figures are of
each by the weights that the others alone teach, with held-out data and, as an ablation, by the evidence alone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from openant_tools.blind.answers import read_answers
from openant_tools.files import json_text, read_toml, write_text
from openant_tools.gap.decide import FILE, OUTSIDE, WEIGHTS, Row, chances
from openant_tools.gap.diagnosis import NONE
from openant_tools.virtual.seal import read_key

#: where weights begin: where all speak as loud as they would if they were right, but nats, of which few are; and how far from there costs as much
#: as one robot's surprise, of those that cannot be negative in logarithms: what should show and does not never speaks for a cause
START = {
    "evidence": 1.0,
    "support": 1.0,
    "shortfall": 0.25,
    "uneven": 0.5,
    "beyond": 0.05,
    "irregular": 0.25,
    "none": 1.0,
    "outside": 0.0,
    "outside: uneven": 1.0,
}
FAR = 0.5
POSITIVE = ("evidence", "support", "shortfall", "uneven", "beyond", "irregular", "outside: uneven")
#: what a row is decided on by
KEPT = ("probability", "support", "foretold", "uneven", "likelier", "within", "irregular")
#: the weights of what held-out data say
HELD_OUT = ("support", "shortfall", "uneven", "beyond", "irregular", "outside: uneven")


@dataclass(frozen=True)
class Judged:
    """What was decided on of one robot, and what is right to say of it."""

    rows: tuple[Row, ...]
    outside: float
    right: frozenset[str]
    ill: bool


def judged(path: Path, key: bytes | None = None) -> list[Judged]:
    """The robots of a set that were diagnosed, or that were kept of one."""
    if path.is_file():
        return [_kept(one) for one in json.loads(path.read_text())]
    answers = read_answers(path, key, str(read_toml(path / "set.toml")["commitment"]))
    return [
        robot(json.loads(found.read_text()), answers[found.stem].as_table())
        for found in sorted((path / "verdicts").glob("*.json"))
    ]


def keep(path: Path, some: Sequence[Judged]) -> None:
    """Write what robots were judged by into a file for `judged`: a line a robot, numbers to six digits."""
    lines = [json.dumps(_as_json(one), separators=(",", ":")) for one in some]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "[\n" + ",\n".join(lines) + "\n]\n")


def _as_json(one: Judged) -> dict[str, object]:
    rows = [[*row.causes, *(_short(getattr(row, name)) for name in KEPT)] for row in one.rows]
    return {"right": sorted(one.right), "ill": one.ill, "outside": _short(one.outside), "rows": rows}


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def _kept(one: Mapping[str, Any]) -> Judged:
    rows = []
    for values in one["rows"]:
        causes, numbers = values[: -len(KEPT)], values[-len(KEPT) :]
        rows.append(Row(tuple(causes), **dict(zip(KEPT, numbers, strict=True))))
    return Judged(tuple(rows), one["outside"], frozenset(one["right"]), one["ill"])


def robot(found: Mapping[str, Any], truth: Mapping[str, Any]) -> Judged:
    rows, outside = [], 0.0
    for row in found["rows"]:
        if row["causes"] == [OUTSIDE]:
            outside = row["probability"]
            continue
        kept = {name: row[name] for name in KEPT if name in row}
        rows.append(Row(tuple(row["causes"]), **kept))
    effects = truth.get("effect", [])
    right = {one["effect"] for one in effects}
    # What is hardly beyond tolerance need not be found.
    if not right:
        right = {OUTSIDE if truth.get("outside") else NONE}
    elif all(one["size"] == "small" for one in effects):
        right |= {NONE}
    return Judged(tuple(rows), outside, frozenset(right), bool(effects))


def learned(sets: Sequence[Sequence[Judged]], *, held_out: bool = True) -> dict[str, float]:
    """The weights under which what is right surprises least; without `held_out` what was not fitted is nothing to them."""
    mine = [name for name in WEIGHTS if held_out or name not in HELD_OUT]
    start = np.array([np.log(START[name]) if name in POSITIVE else START[name] for name in mine])

    def named(x: NDArray[np.float64]) -> dict[str, float]:
        found = {name: float(np.exp(v) if name in POSITIVE else v) for name, v in zip(mine, x, strict=True)}
        return {name: found.get(name, 0.0) for name in WEIGHTS}

    def surprise(x: NDArray[np.float64]) -> float:
        return float(np.square((x - start) / FAR).sum()) + sum(
            _surprise(one, named(x)) for some in sets for one in some
        )

    return named(minimize(surprise, start).x)


def _surprise(one: Judged, weights: Mapping[str, float]) -> float:
    p = chances(one.rows, one.outside, weights)
    return -float(np.log(max(sum(p.get(name, 0.0) for name in one.right), 1e-6)))


def figures(some: Sequence[Judged], weights: Mapping[str, float]) -> dict[str, str]:
    """Shares: first among causes, among the first two, likeliest of all (of ill ones, healthy ones, outsiders), and mean surprise."""
    first, two, ill, healthy, outsiders = [], [], [], [], []
    for one in some:
        p = chances(one.rows, one.outside, weights)
        order = sorted((name for name in p if name not in (NONE, OUTSIDE)), key=lambda name: -p[name])
        likeliest = max(p, key=lambda name: p[name]) in one.right
        if one.ill:
            first.append(order[0] in one.right)
            two.append(bool(set(order[:2]) & one.right))
            ill.append(likeliest)
        elif NONE in one.right:
            healthy.append(likeliest)
        else:
            outsiders.append(likeliest)
    parts = {"first": first, "first two": two, "ill": ill, "healthy": healthy, "outside": outsiders}
    surprise = np.mean([_surprise(one, weights) for one in some])
    return {name: f"{sum(of)} of {len(of)}" for name, of in parts.items()} | {"surprise": f"{surprise:.2f}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument(
        "--key-file", type=Path, action="append", default=[], help="of each set, in order; none where answers are open"
    )
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for path in options.sets:
        if not path.is_file() and not (path / "set.toml").is_file():
            parser.error(f"{path} is neither a set nor what was kept of one")
    if options.key_file and len(options.key_file) != len(options.sets):
        parser.error("name a key for each set, or none")
    keys: list[bytes | None] = [read_key(path) for path in options.key_file]
    keys = keys or [None] * len(options.sets)
    sets = [judged(folder, key) for folder, key in zip(options.sets, keys, strict=True)]
    for folder, some in zip(options.sets, sets, strict=True) if options.keep else ():
        keep(options.keep / f"{folder.stem}.json", some)
    for n, folder in enumerate(options.sets):
        print(folder.name, "by the weights it begins with:", figures(sets[n], START))
        if others := [some for k, some in enumerate(sets) if k != n]:
            print(folder.name, "by the others:", figures(sets[n], learned(others)))
            print(folder.name, "the same, evidence alone:", figures(sets[n], learned(others, held_out=False)))
    weights = learned(sets)
    print({name: round(value, 3) for name, value in weights.items()})
    for folder, some in zip(options.sets, sets, strict=True):
        print(folder.name, "by all:", figures(some, weights))
    if options.out:
        write_text(options.out / FILE, json_text(weights))


if __name__ == "__main__":
    main()
