"""What must be computed once for a model and a protocol: thousands of simulated robots. Cached, resumable, bounded in size.

A prepared protocol is a folder of parts, each of a few dozen robots, written whole or not at all: what is interrupted goes on
where it stopped. It is found again by model and commands, whatever the time stamps' jitter.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.files import atomic_writer, write_text
from openant_tools.gap.features import Floats
from openant_tools.gap.population import Case, applicable, draw, play, templates
from openant_tools.gap.protocol import Protocol, same, shown
from openant_tools.recording.run import Run

__all__ = ["Prepared", "cache_folder", "find", "prepare"]

Array = NDArray[np.float64]

#: the environment variable that names the cache, and how large it may grow
CACHE_VARIABLE = "OPENANT_CACHE"
LARGEST_BYTES = 4 * 2**30
#: what is stored is bound to the code that made it: raise it when simulated robots change
VERSION = 5
#: robots of a part, and of a whole preparation where the robot has many joints and where it has one or two
PART, ROBOTS, ROBOTS_ONE_JOINT = 96, 2400, 16_000
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Prepared:
    """Simulated robots of one protocol.

    Attributes:
        protocol: the one that was prepared. folder: where it is kept.
        cases: the robots. features: of each run, (robots, features).
        bank: robots that are as the model says but for one cause. templates: of each run, their features.
    """

    protocol: Protocol
    folder: Path
    cases: tuple[Case, ...]
    features: tuple[Floats, ...]
    bank: tuple[Case, ...]
    templates: tuple[Floats, ...]

    def healthy(self) -> NDArray[np.bool_]:
        """(robots,) which have no cause."""
        return np.array([not case.causes for case in self.cases])


def cache_folder() -> Path:
    """Where prepared protocols are kept."""
    given = os.environ.get(CACHE_VARIABLE)
    base = Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "openant"
    return base / "gap"


def robots_of(protocol: Protocol) -> int:
    """How many robots a protocol's preparation has where nothing else is said."""
    return ROBOTS_ONE_JOINT if len(protocol.joints) <= 2 else ROBOTS


def prepare(protocol: Protocol, robots: int | None = None, progress: Progress | None = None) -> Prepared:
    """Simulate what is missing of a protocol's robots and return them all.

    Args:
        robots: how many; default by the number of joints.
        progress: told a share and words.
    """
    robots = robots or robots_of(protocol)
    folder, order = find(protocol) or (_new(protocol), list(range(len(protocol.runs))))
    # From here on in the order of whoever prepared it first.
    known = _reference(folder, dataclasses.replace(protocol, runs=tuple(protocol.runs[k] for k in order)))
    coarse = known.coarse()
    causes = applicable(coarse)
    size = PART if len(protocol.joints) > 2 else 8 * PART
    parts = -(-robots // size)
    bank = templates(coarse)
    banks = -(-len(bank) // size)
    # Templates count below 0.
    missing = [part for part in range(-banks, parts) if not _part(folder, part).is_file()]
    whole, there = (parts + banks) * size, (parts + banks - len(missing)) * size
    jobs = joblib.Parallel(n_jobs=-1, return_as="generator_unordered")
    for done, _ in enumerate(jobs(joblib.delayed(_make)(coarse, n, size, _part(folder, n)) for n in missing), 1):
        if progress is not None:
            progress(done / len(missing), f"{there + done * size} of {whole} simulated robots")
    if missing:
        _keep_small(folder)
    os.utime(folder)
    features: list[list[Floats]] = [[] for _ in coarse.runs]
    for part in [*range(parts), *range(-1, -banks - 1, -1)]:
        with np.load(_part(folder, part)) as stored:
            for k in range(len(coarse.runs)):
                features[k].append(stored[f"run{k}"].astype(np.float32))
    cases = [draw(coarse, k, causes) for k in range(parts * size)]
    n = len(cases)
    back = [order.index(k) for k in range(len(order))]
    mine = [np.concatenate(features[k]) for k in back]
    return Prepared(
        dataclasses.replace(known, runs=tuple(known.runs[k] for k in back)),
        folder,
        tuple(cases),
        tuple(x[:n] for x in mine),
        tuple(bank),
        tuple(x[n:] for x in mine),
    )


def _make(protocol: Protocol, part: int, size: int, path: Path) -> None:
    """One part, in a process of its own: processes do not wait for each other at every step as threads would."""
    if part < 0:
        cases = templates(protocol)[(-part - 1) * size : -part * size]
    else:
        causes = applicable(protocol)
        cases = [draw(protocol, part * size + k, causes) for k in range(size)]
    found = play(protocol, cases, max(part, 0))
    _write(path, {f"run{k}": x.astype(np.float16) for k, x in enumerate(found)})


def find(protocol: Protocol) -> tuple[Path, list[int]] | None:
    """The folder of the same model and commands, if it was ever begun, and which of the runs are its first, second …"""
    commands = protocol.commands()
    for folder in sorted(cache_folder().glob(f"v{VERSION}-{protocol.fingerprint()}-*")):
        try:
            with np.load(folder / "protocol.npz") as stored:
                known = [stored[f"cmd{k}"] for k in range(len(stored.files))]
        except (OSError, KeyError, ValueError):
            continue
        order: list[int] = []
        for one in known:
            order += [k for k, mine in enumerate(commands) if k not in order and same([one], [mine])][:1]
        if len(order) == len(known) == len(commands):
            return folder, order
    return None


def _new(protocol: Protocol) -> Path:
    base = cache_folder()
    base.mkdir(parents=True, exist_ok=True)
    stem = f"v{VERSION}-{protocol.fingerprint()}"
    number = 0
    while True:
        folder = base / f"{stem}-{number}"
        try:
            folder.mkdir()
            break
        except FileExistsError:
            number += 1
    _write(folder / "protocol.npz", {f"cmd{k}": table for k, table in enumerate(protocol.commands())})
    facts = {"model": str(protocol.model), "runs": [one.run.name for one in protocol.runs], "made": time.strftime("%F")}
    write_text(folder / "facts.json", json.dumps(facts, indent=2) + "\n")
    return folder


def _reference(folder: Path, protocol: Protocol) -> Protocol:
    """The protocol as it was prepared: its runs' times and commands are those of whoever came first."""
    path = folder / "first.npz"
    if not path.is_file():
        columns: dict[str, NDArray[np.float64]] = {}
        for k, one in enumerate(protocol.runs):
            columns[f"{k}|t"] = one.run.t
            for name, values in one.run.columns.items():
                if values.dtype.kind == "f":
                    columns[f"{k}|{name}"] = values
        _write(path, columns)
    with np.load(path) as stored:
        runs = []
        for k, one in enumerate(protocol.runs):
            mine = {name.partition("|")[2]: stored[name] for name in stored.files if name.startswith(f"{k}|")}
            run = Run(one.run.name, one.run.facts, mine.pop("t"), mine, one.run.path)
            runs.append(dataclasses.replace(one, run=run))
    found = dataclasses.replace(protocol, runs=tuple(runs))
    return dataclasses.replace(
        found, reference=dataclasses.replace(protocol.reference, seen=shown([one.run for one in runs], protocol.joints))
    )


def _part(folder: Path, part: int) -> Path:
    return folder / (f"part-{part:04d}.npz" if part >= 0 else f"bank-{-part:04d}.npz")


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with atomic_writer(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes the names for options


def _keep_small(kept: Path) -> None:
    """Drop what was used longest ago until the cache is within its bound."""
    folders = sorted((f for f in cache_folder().iterdir() if f.is_dir()), key=lambda folder: folder.stat().st_mtime)
    total = {folder: sum(file.stat().st_size for file in folder.iterdir()) for folder in folders}
    for folder in folders:
        if sum(total.values()) <= LARGEST_BYTES:
            return
        if folder != kept:
            shutil.rmtree(folder, ignore_errors=True)
            del total[folder]
