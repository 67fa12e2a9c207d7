"""Learn how the decision weighs evidence against held-out data, from robots that were diagnosed and whose answers are open.

    openant gap blind make --out SET --seed 1 --open …; openant gap blind run SET
    python -m benchmarks.gap_training.decision SET… [--keep benchmarks/gap_training/judged] [--out openant_tools/gap]

What a diagnosis decided on stands in its JSON (`rows`), so that nothing is simulated here; `--keep` writes that of each set into one small
file, which may be named in the set's place. Sets of several makers are named together, and figures are of
each by the weights that the others alone teach, and, as an ablation, by templates alone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from openant_tools.blind.answers import read_answers
from openant_tools.files import json_text, read_toml, write_text
from openant_tools.gap.decide import FILE, OUTSIDE, WEIGHTS, Anomaly, Row, chances, present
from openant_tools.gap.decide import weights as shipped
from openant_tools.gap.diagnosis import NONE
from openant_tools.virtual.seal import read_key

#: where weights begin: where all speak as loud as they would if they were right, but nats, of which few are; and how far from there costs as much
#: as one robot's surprise, of those that cannot be negative in logarithms: what should show and does not never speaks for a cause. The two of
#: further causes begin with how often the others of 60 ill robots have a cause that so much of what is left goes along
START = {
    "fit": 0.05,
    "support": 1.0,
    "shortfall": 0.25,
    "uneven": 0.5,
    "beyond": 0.05,
    "irregular": 0.25,
    "none": 3.0,
    "none: size": 5.0,
    "outside": 1.0,
    "outside: left": 5.0,
    "outside: uneven": 1.0,
    "beside": -4.75,
    "beside: fit": 0.019,
}
FAR = 0.5
POSITIVE = tuple(name for name in START if name not in ("none", "outside", "beside"))
#: what a row is decided on by
KEPT = ("fit", "support", "foretold", "uneven", "likelier", "within", "irregular")
#: the weights of what a further cause is decided on by, and those of what fits say
BESIDE = ("beside", "beside: fit")
FITTED = ("support", "shortfall", "uneven", "beyond", "irregular", "outside: uneven")


@dataclass(frozen=True)
class Judged:
    """What was decided on of one robot, and what is right to say of it.

    Attributes:
        ill: whether it has a cause of the catalogue. declined: what was asked for beside a cause and not added; as `Diagnosis` has it.
    """

    rows: tuple[Row, ...]
    anomaly: Anomaly
    right: frozenset[str]
    ill: bool
    declined: tuple[Row, ...] = ()

    def beside(self) -> Iterator[tuple[list[Row], float]]:
        """What was asked for beside each set of causes, and how unevenly that left joints."""
        asked = [row for row in (*self.rows, *self.declined) if len(row.causes) > 1]
        uneven = {row.causes: row.uneven or 0.0 for row in self.rows}
        for base in dict.fromkeys(row.causes[:-1] for row in asked):
            yield [row for row in asked if row.causes[:-1] == base], uneven.get(base, 0.0)


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
    rows, declined = (
        [[*row.causes, *(short(getattr(row, name)) for name in KEPT)] for row in some]
        for some in (one.rows, one.declined)
    )
    anomaly = [short(one.anomaly.size), short(one.anomaly.left)]
    kept = {"right": sorted(one.right), "ill": one.ill, "anomaly": anomaly, "rows": rows}
    return kept | ({"declined": declined} if declined else {})


def short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def _kept(one: Mapping[str, Any]) -> Judged:
    rows, declined = (
        tuple(
            Row(tuple(values[: -len(KEPT)]), **dict(zip(KEPT, values[-len(KEPT) :], strict=True)))
            for values in one.get(name, ())
        )
        for name in ("rows", "declined")
    )
    return Judged(rows, Anomaly(*one["anomaly"]), frozenset(one["right"]), one["ill"], declined)


def robot(found: Mapping[str, Any], truth: Mapping[str, Any]) -> Judged:
    rows, declined = (
        tuple(Row(tuple(row["causes"]), **{key: row[key] for key in KEPT}) for row in found[name] if row["leads"])
        for name in ("rows", "declined")
    )
    effects = truth.get("effect", [])
    right = {one["effect"] for one in effects}
    # What is hardly beyond tolerance need not be found.
    if not right:
        right = {OUTSIDE if truth.get("outside") else NONE}
    elif all(one["size"] == "small" for one in effects):
        right |= {NONE}
    return Judged(rows, Anomaly(**found["anomaly"]), frozenset(right), bool(effects), declined)


def learned(sets: Sequence[Sequence[Judged]], *, fitted: bool = True) -> dict[str, float]:
    """The weights under which what is right surprises least; without `fitted` what fits say is nothing to them."""
    every = [one for some in sets for one in some]
    leading = [name for name in WEIGHTS if name not in BESIDE and (fitted or name not in FITTED)]
    found = _least(leading, dict.fromkeys(WEIGHTS, 0.0), lambda weights: sum(_surprise(one, weights) for one in every))
    return _least(list(BESIDE), found, lambda weights: sum(_beside(one, weights) for one in every))


def _least(
    mine: Sequence[str], others: Mapping[str, float], surprise: Callable[[Mapping[str, float]], float]
) -> dict[str, float]:
    """Some weights, beside others, by which surprise is least, not far from where they begin."""
    start = np.array([np.log(START[name]) if name in POSITIVE else START[name] for name in mine])

    def named(x: NDArray[np.float64]) -> dict[str, float]:
        own = {name: float(np.exp(v) if name in POSITIVE else v) for name, v in zip(mine, x, strict=True)}
        return {**others, **own}

    return named(minimize(lambda x: float(np.square((x - start) / FAR).sum()) + surprise(named(x)), start).x)


def _surprise(one: Judged, weights: Mapping[str, float]) -> float:
    p = chances(one.rows, one.anomaly, weights)
    return -float(np.log(max(sum(p.get(name, 0.0) for name in one.right), 1e-6)))


def _beside(one: Judged, weights: Mapping[str, float]) -> float:
    """Of what was asked for beside a robot's causes: whether each is there."""
    whole = 0.0
    for rows, uneven in one.beside() if one.ill else ():
        for name, p in present(rows, uneven, weights).items():
            whole -= float(np.log(max(p if name in one.right else 1 - p, 1e-6)))
    return whole


def figures(some: Sequence[Judged], weights: Mapping[str, float]) -> dict[str, str]:
    """Shares: first among causes, among the first two, likeliest of all (of ill ones, healthy ones, outsiders), and mean surprise."""
    first, two, ill, healthy, outsiders = [], [], [], [], []
    for one in some:
        p = chances(one.rows, one.anomaly, weights)
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
        print(folder.name, "by the shipped ones:", figures(sets[n], shipped()))
        if others := [some for k, some in enumerate(sets) if k != n]:
            print(folder.name, "by the others:", figures(sets[n], learned(others)))
            print(folder.name, "the same, templates alone:", figures(sets[n], learned(others, fitted=False)))
    weights = learned(sets)
    print({name: round(value, 3) for name, value in weights.items()})
    for folder, some in zip(options.sets, sets, strict=True):
        print(folder.name, "by all:", figures(some, weights))
    if options.out:
        write_text(options.out / FILE, json_text(weights))


if __name__ == "__main__":
    main()
