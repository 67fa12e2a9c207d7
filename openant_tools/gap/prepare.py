"""What must be computed once for a model and a protocol: thousands of simulated robots. Cached, resumable, bounded in size.

A prepared protocol is a folder of parts, each of a few dozen robots, written whole or not at all: what is interrupted goes on
where it stopped. It is found again by model and commands, whatever the time stamps' jitter.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.arrays import read_arrays, write_arrays
from openant_tools.errors import BadInput
from openant_tools.files import json_text, write_text
from openant_tools.gap.features import Floats
from openant_tools.gap.population import Case, applicable, draw, play, templates
from openant_tools.gap.protocol import Protocol, same, shown
from openant_tools.recording.run import Run
from openant_tools.workers import tied

__all__ = ["Prepared", "cache_folder", "find", "finished_since", "keep_small", "prepare"]

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: the environment variable that names the cache, and how large it may grow
CACHE_VARIABLE = "OPENANT_CACHE"
LARGEST_BYTES = 4 * 2**30
PRIVATE = 0o700
#: what is stored is bound to the code that made it: raise it when simulated robots change
VERSION = 19
#: robots of a part, and of a whole preparation where the robot has many joints and where it has one or two
PART, ROBOTS, ROBOTS_ONE_JOINT = 96, 4320, 16_000
#: robots without which no judge is trained, and the file that says that no more are to be made unless asked for
LEAST, CLOSED = 480, "closed"
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Prepared:
    """Simulated robots of one protocol.

    Attributes:
        protocol: the one that was prepared. folder: where it is kept.
        which: of each run, which of those kept there it is.
        cases: the robots. parts: where they are kept.
        bank: robots that are as the model says but for one cause. banks: where they are kept.
    """

    protocol: Protocol
    folder: Path
    which: tuple[int, ...]
    cases: tuple[Case, ...]
    parts: tuple[int, ...]
    bank: tuple[Case, ...]
    banks: tuple[int, ...]

    @cached_property
    def features(self) -> tuple[Floats, ...]:
        """Of each run, (robots, features)."""
        return self._read(self.parts)

    @cached_property
    def templates(self) -> tuple[Floats, ...]:
        """Of each run, (robots of the bank, features)."""
        return self._read(self.banks)

    def _read(self, parts: Sequence[int]) -> tuple[Floats, ...]:
        found: list[list[Floats]] = [[] for _ in self.which]
        for part in parts:
            stored = read_arrays(_part(self.folder, part))
            for mine, k in zip(found, self.which, strict=True):
                mine.append(stored[f"run{k}"].astype(np.float32))
        return tuple(np.concatenate(mine) for mine in found)

    @property
    def ordered(self) -> list[int]:
        """The runs at hand in the order in which they were prepared, in whatever they are named: so one judge serves them all."""
        return sorted(range(len(self.which)), key=lambda k: self.which[k])

    def healthy(self) -> NDArray[np.bool_]:
        """(robots,) which have no cause."""
        return np.array([not case.causes for case in self.cases])


def cache_folder() -> Path:
    """Where prepared protocols are kept, for nobody but this user.

    Raises:
        BadInput: the folder is another user's.
    """
    given = os.environ.get(CACHE_VARIABLE)
    base = Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "openant"
    folder = base / "gap"
    if folder.exists() and (mode := folder.stat()).st_uid != os.geteuid():
        raise BadInput(
            f"the cache belongs to another user (number {mode.st_uid})",
            where=folder,
            remedy=f"name a folder of your own by {CACHE_VARIABLE}",
        )
    folder.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    folder.chmod(PRIVATE)  # where an older version made it
    return folder


def finished_since(when: float) -> bool:
    """Whether any protocol's preparation has come to its end since then, s as `time.time` counts them."""
    return any(path.stat().st_mtime >= when for path in cache_folder().glob(f"*/{CLOSED}"))


def robots_of(protocol: Protocol) -> int:
    """How many robots a protocol's preparation has where nothing else is said."""
    return ROBOTS_ONE_JOINT if len(protocol.joints) <= 2 else ROBOTS


def prepare(
    protocol: Protocol, robots: int | None = None, *, seconds: float | None = None, progress: Progress | None = None
) -> Prepared:
    """Simulate what is missing of a protocol's robots and return them all.

    Args:
        robots: how many; default by the number of joints, or however many an earlier time limit left.
        seconds: after which no more are begun, once there are enough to judge by at all.
        progress: told a share and words.
    """
    kept = find(protocol, whole=robots is not None) or _new(protocol)
    protocol = _as_first(kept, protocol).at_rest()
    coarse = protocol.coarse()
    size = PART if len(protocol.joints) > 2 else 8 * PART
    parts = -(-(robots or robots_of(protocol)) // size)
    bank = templates(coarse)
    banks = -(-len(bank) // size)
    broken = _drop_broken(kept.folder, range(-banks, parts), size, len(bank))
    if robots is not None or not (kept.folder / CLOSED).exists():
        _simulate(kept, coarse, range(-banks, parts), size, seconds, progress)
    elif broken:
        _simulate(kept, coarse, broken, size, None, progress)
    os.utime(kept.folder)
    there = [part for part in range(parts) if _part(kept.folder, part).is_file()]
    if len(there) * size >= robots_of(protocol) and not (kept.folder / CLOSED).exists():
        write_text(kept.folder / CLOSED, "")
    causes = applicable(coarse)
    cases = [draw(coarse, part * size + k, causes) for part in there for k in range(size)]
    return Prepared(
        protocol, kept.folder, kept.which, tuple(cases), tuple(there), tuple(bank), tuple(range(-1, -banks - 1, -1))
    )


def _drop_broken(folder: Path, parts: Sequence[int], size: int, bank: int) -> list[int]:
    """Remove the parts that are not what `_make` wrote, and say which: they are to be made anew.

    Args:
        size: robots of a part. bank: robots of the whole bank.
    """
    runs = len(_protocol(folder)[0])
    widths: list[int] | None = None
    broken = []
    for part in parts:
        path = _part(folder, part)
        if not path.is_file():
            continue
        rows = size if part >= 0 else min(size, bank - (-part - 1) * size)
        try:
            stored = read_arrays(path)
            seen = [stored[f"run{k}"] for k in range(runs)]
            if not all(x.dtype == np.float16 and x.ndim == 2 and len(x) == rows for x in seen):
                raise BadInput("holds other arrays", where=path)
            widths = widths or [x.shape[1] for x in seen]
            if [x.shape[1] for x in seen] != widths:
                raise BadInput("holds other arrays", where=path)
        except (BadInput, KeyError) as error:
            _log.warning("%s; it is made anew", error if isinstance(error, BadInput) else f"{path}: it lacks a run")
            path.unlink()
            broken.append(part)
    return broken


def _simulate(
    kept: Kept, coarse: Protocol, parts: Sequence[int], size: int, seconds: float | None, progress: Progress | None
) -> None:
    """Make the parts that are missing."""
    folder, begun = kept.folder, time.monotonic()
    missing = [part for part in parts if not _part(folder, part).is_file()]
    if not missing:
        return
    ordered = dataclasses.replace(coarse, runs=tuple(coarse.runs[k] for k in np.argsort(kept.which)))
    whole, there = len(parts) * size, (len(parts) - len(missing)) * size
    jobs = joblib.Parallel(n_jobs=-1, return_as="generator_unordered")
    with warnings.catch_warnings():
        # That a process which has grown is replaced is no one's concern, and that what was begun is dropped in the end is meant.
        warnings.simplefilter("ignore", UserWarning)
        made = jobs(joblib.delayed(tied(_make))(ordered, n, size, _part(folder, n)) for n in missing)
        for done, _ in enumerate(made, 1):
            if progress is not None:
                progress(done / len(missing), f"{there + done * size} of {whole} simulated robots")
            enough = all(_part(folder, part).is_file() for part in parts if part * size < LEAST)
            if seconds is not None and enough and time.monotonic() - begun > seconds:
                write_text(folder / CLOSED, "")
                made.close()
                break
    keep_small(folder)


def _make(protocol: Protocol, part: int, size: int, path: Path) -> None:
    """One part, in a process of its own: processes do not wait for each other at every step as threads would."""
    if part < 0:
        cases = templates(protocol)[(-part - 1) * size : -part * size]
    else:
        causes = applicable(protocol)
        cases = [draw(protocol, part * size + k, causes) for k in range(size)]
    found = play(protocol, cases, max(part, 0))
    write_arrays(path, {f"run{k}": x.astype(np.float16) for k, x in enumerate(found)})


@dataclass(frozen=True)
class Kept:
    """Where a protocol is kept.

    Attributes:
        which: for each of the runs at hand, which of the runs kept there it is.
    """

    folder: Path
    which: tuple[int, ...]


def find(protocol: Protocol, *, whole: bool = False) -> Kept | None:
    """Where the same model and commands are kept, if they ever were begun.

    Args:
        whole: only with the very same runs. Else a finished one that has others besides will do.
    """
    commands, places = protocol.commands(), protocol.places()
    more: Kept | None = None
    for folder in sorted(cache_folder().glob(f"v{VERSION}-{protocol.fingerprint()}-*")):
        try:
            stood, known = _protocol(folder)
            _first(folder, len(stood))
        except OSError:
            continue  # being made
        except BadInput as error:
            _log.warning("%s; the robots are simulated anew", error)
            shutil.rmtree(folder, ignore_errors=True)
            continue
        which: list[int] = []
        for one, place in zip(commands, places, strict=True):
            alike = [k for k in range(len(known)) if k not in which and (stood[k] == place).all()]
            which += [k for k in alike if same(known[k], one)][:1]
        if len(which) != len(commands):
            continue
        if len(known) == len(commands):
            return Kept(folder, tuple(which))
        if (folder / CLOSED).exists() and more is None:
            more = Kept(folder, tuple(which))
    return None if whole else more


def _protocol(folder: Path) -> tuple[Array, list[Array]]:
    """(runs, 2) the places, and of each run the commands, that were prepared in a folder; raises BadInput."""
    path = folder / "protocol.npz"
    stored = read_arrays(path)
    places = stored.pop("places", np.empty(0))
    commands = [stored.get(f"cmd{k}", np.empty(0)) for k in range(len(stored))]
    good = len(commands) > 0 and places.shape == (len(commands), 2)
    if not good or any(x.dtype != np.float64 for x in (places, *commands)) or any(x.ndim != 2 for x in commands):
        raise BadInput("holds no protocol", where=path)
    return places, commands


def _first(folder: Path, runs: int) -> list[dict[str, Array]]:
    """Of each run that was prepared in a folder its columns, t among them; raises BadInput."""
    path = folder / "first.npz"
    columns: list[dict[str, Array]] = [{} for _ in range(runs)]
    for key, values in read_arrays(path).items():
        number, _, name = key.partition("|")
        mine = dict(zip(map(str, range(runs)), columns, strict=True)).get(number)
        if mine is None or values.dtype != np.float64:
            raise BadInput("holds other columns", where=path)
        mine[name] = values
    for mine in columns:
        t = mine.get("t", np.empty((0, 0)))
        if t.ndim != 1 or any(values.shape != t.shape for values in mine.values()) or not (np.diff(t) > 0).all():
            raise BadInput("holds other columns", where=path)
    return columns


def _new(protocol: Protocol) -> Kept:
    base = cache_folder()
    stem = f"v{VERSION}-{protocol.fingerprint()}"
    number = 0
    while True:
        folder = base / f"{stem}-{number}"
        try:
            folder.mkdir(mode=PRIVATE)
            break
        except FileExistsError:
            number += 1
    columns: dict[str, NDArray[np.float64]] = {}
    for k, one in enumerate(protocol.runs):
        columns[f"{k}|t"] = one.run.t
        for name, values in one.run.columns.items():
            if values.dtype.kind == "f":
                columns[f"{k}|{name}"] = values
    write_arrays(folder / "first.npz", columns)
    facts = {"model": str(protocol.model), "runs": [one.run.name for one in protocol.runs], "made": time.strftime("%F")}
    write_text(folder / "facts.json", json_text(facts, indent=2))
    # Last: by it others find the folder.
    tables = {f"cmd{k}": table for k, table in enumerate(protocol.commands())}
    write_arrays(folder / "protocol.npz", {"places": protocol.places(), **tables})
    return Kept(folder, tuple(range(len(protocol.runs))))


def _as_first(kept: Kept, protocol: Protocol) -> Protocol:
    """The protocol as it was prepared: its runs' times and commands are those of whoever came first."""
    columns = _first(kept.folder, len(_protocol(kept.folder)[0]))
    times = [mine.pop("t") for mine in columns]
    runs = [
        dataclasses.replace(one, run=Run(one.run.name, one.run.facts, times[k], columns[k], one.run.path))
        for k, one in zip(kept.which, protocol.runs, strict=True)
    ]
    facts = protocol.runs[0].run.facts
    everything = [Run(str(k), facts, t, mine) for k, (t, mine) in enumerate(zip(times, columns, strict=True))]
    reference = dataclasses.replace(protocol.reference, seen=shown(everything, protocol.joints))
    return dataclasses.replace(protocol, runs=tuple(runs), reference=reference)


def _part(folder: Path, part: int) -> Path:
    return folder / (f"part-{part:04d}.npz" if part >= 0 else f"bank-{-part:04d}.npz")


def keep_small(kept: Path) -> None:
    """Drop what was used longest ago, protocols and recordings alike, until the cache is within its bound."""
    places = sorted(cache_folder().iterdir(), key=lambda place: place.stat().st_mtime)
    total = {
        place: sum(file.stat().st_size for file in (place.iterdir() if place.is_dir() else [place])) for place in places
    }
    for place in places:
        if sum(total.values()) <= LARGEST_BYTES:
            return
        if place != kept:
            if place.is_dir():
                shutil.rmtree(place, ignore_errors=True)
            else:
                place.unlink(missing_ok=True)
            del total[place]
