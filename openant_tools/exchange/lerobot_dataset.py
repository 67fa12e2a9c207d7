"""A LeRobot dataset on the disk: what `meta/info.json` says of it, and its episodes as they stand there, in its own units.

The layout (v3.0): `data/chunk-000/file-000.parquet`, many episodes a file, with `episode_index`, `frame_index`, `timestamp`,
`observation.state`, `action`; `meta/episodes/chunk-000/file-000.parquet`, a row an episode, with its length and its file. In v2.0
and v2.1 each episode has a file of its own with the same columns, and `meta/episodes.jsonl`, which is not needed to read it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.files import read_json, reading
from openant_tools.numbers import literal, number
from openant_tools.optional import pa
from openant_tools.recording.plausibility import check_time
from openant_tools.recording.run import Array
from openant_tools.recording.tables import parquet_table

__all__ = ["ACTION", "STATE", "DatasetEpisode", "DatasetFacts", "episodes", "open_dataset"]

STATE, ACTION = "observation.state", "action"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VERSIONS = ("v2.0", "v2.1", "v3.0")
#: of a dataset; the largest public ones have a tenth of it
MOST_EPISODES = 10**6
#: the share by which rows may be further apart or nearer than the rate says, and s within which LeRobot itself calls them in time
RATE_SHARE, IN_TIME_S = 0.1, 1e-4
#: the beginning of a file that git has not brought yet
LFS_POINTER = b"version https://git-lfs"
REPEAT = "copy or download the dataset again"


@dataclass(frozen=True)
class DatasetFacts:
    """What is known of a dataset before its rows are read.

    Attributes:
        root: the folder that holds `meta` and `data`.
        fps: rows a second.
        robot: LeRobot's name of the robot's kind, such as `so101_follower`, or "".
        state, action: names of the numbers in a row of `observation.state` and of `action`.
        files: with rows, in the dataset's order.
        lengths: episode → rows that it has to have; empty where the dataset does not say.
        tasks: episode → what was done, in words.
    """

    root: Path
    fps: float
    robot: str
    state: tuple[str, ...]
    action: tuple[str, ...]
    files: tuple[Path, ...]
    lengths: Mapping[int, int] = field(default_factory=dict)
    tasks: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetEpisode:
    """The rows of one episode.

    Attributes:
        index: its number in the dataset.
        t: (n,) s from its beginning, strictly increasing.
        state, action: (n, names), finite, in the dataset's own units.
        counted: whether `t` is frame over rate, as LeRobot writes it, and not when the row was taken.
    """

    index: int
    t: Array
    state: Array
    action: Array
    counted: bool


def open_dataset(root: Path) -> DatasetFacts:
    """What the dataset in the folder `root` says of itself.

    Raises:
        BadInput: it is none, of a version that is not read, or lacks a feature, a name or a file.
        OSError: it cannot be read.
    """
    where = root / "meta" / "info.json"
    if not where.is_file():
        raise BadInput(
            "there is no LeRobot dataset: meta/info.json is missing",
            where=root,
            remedy="name the folder that holds meta/ and data/, such as ~/.cache/huggingface/lerobot/OWNER/NAME",
        )
    info = read_json(where, REPEAT)
    if not isinstance(info, dict):
        raise BadInput("is not what LeRobot writes there: an object", where=where, remedy=REPEAT)
    version = info.get("codebase_version")
    if version not in VERSIONS:
        raise BadInput(
            f"`codebase_version` is {str(version)[:40]}",
            where=where,
            remedy=f"read are {', '.join(VERSIONS)}; convert it with LeRobot (lerobot.scripts.convert_dataset_v21_to_v30)",
        )
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not (math.isfinite(fps) and 0.0 < fps < 1e5):
        raise BadInput(f"`fps` is {str(fps)[:40]}", where=where, remedy="write the rows a second there")
    robot = info.get("robot_type")
    files = tuple(sorted((root / "data").glob("*/*.parquet")))
    if not files:
        raise BadInput("there are no rows: data/chunk-000/*.parquet is missing", where=root, remedy=REPEAT)
    # LeRobot finds rows by this pattern, whatever `data_path` says; of another one a missing file is seen by its episodes.
    standard = info.get("data_path", DATA_PATH) == DATA_PATH
    lengths, tasks = _declared(root, standard) if version == "v3.0" else ({}, {})
    if not lengths:
        total = info.get("total_episodes")
        if isinstance(total, int) and 0 < total <= MOST_EPISODES:
            lengths = dict.fromkeys(range(total), 0)
    return DatasetFacts(
        root,
        float(fps),
        robot if isinstance(robot, str) else "",
        _names(info, STATE, where),
        _names(info, ACTION, where),
        files,
        lengths,
        tasks,
    )


def episodes(dataset: DatasetFacts) -> Iterator[DatasetEpisode]:
    """The episodes one after another, checked; what is held at a time is a file and the episode that it ends with.

    Raises:
        BadInput: a row cannot be, or one is missing; the file, the episode and the row are named.
    """
    seen: set[int] = set()
    kept: list[_Rows] = []
    for path in dataset.files:
        with reading(path, "these rows cannot be read", REPEAT):
            parts = _rows(path, dataset)
        for part in parts:
            if kept and kept[0].episode != part.episode:
                yield _episode(kept, dataset)
                kept = []
            if not kept and part.episode in seen:
                raise BadInput(f"the rows of episode {part.episode} lie apart", where=path, remedy=REPEAT)
            seen.add(part.episode)
            kept.append(part)
    if kept:
        yield _episode(kept, dataset)
    missing = sorted(set(dataset.lengths) - seen)
    if missing:
        words = ", ".join(map(str, missing[:5])) + (", …" if len(missing) > 5 else "")
        raise BadInput(
            f"episode {words} is missing: {len(seen)} of {len(dataset.lengths)} are there",
            where=dataset.root / "data",
            remedy=REPEAT,
        )


@dataclass(frozen=True)
class _Rows:
    """Rows of one episode that follow each other in one file."""

    path: Path
    episode: int
    frame: Array
    timestamp: Array
    state: Array
    action: Array


def _names(info: Mapping[str, Any], key: str, where: Path) -> tuple[str, ...]:
    """Names of the numbers of a feature: a list of them, or an object of such lists."""
    features = info.get("features")
    if not isinstance(features, dict) or not isinstance(features.get(key), dict):
        raise BadInput(
            f"there is no {key} among the features",
            where=where,
            remedy=f"a run needs {STATE} (what was measured) and {ACTION} (what was commanded)",
        )
    feature = features[key]
    names = feature.get("names")
    if isinstance(names, dict):
        names = [name for part in names.values() if isinstance(part, list) for name in part]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise BadInput(
            f"the numbers of {key} have no names", where=where, remedy=f"write the joints into `features.{key}.names`"
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInput(f"{key} names {twice[0]} twice", where=where, remedy="name each joint once")
    shape = feature.get("shape")
    if isinstance(shape, list) and shape != [len(names)]:
        raise BadInput(
            f"{key} has {len(names)} names for the shape {str(shape)[:40]}", where=where, remedy="name each number once"
        )
    return tuple(names)


def _declared(root: Path, standard: bool) -> tuple[dict[int, int], dict[int, str]]:
    """What `meta/episodes` says: how many rows each episode has, and what was done in it."""
    lengths: dict[int, int] = {}
    tasks: dict[int, str] = {}
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        with reading(path, "this list of episodes cannot be read", REPEAT):
            table = _table(path, ("episode_index", "length", "tasks", "data/chunk_index", "data/file_index"))
            if len(table) + len(lengths) > MOST_EPISODES:
                raise BadInput(f"it lists more than {MOST_EPISODES} episodes", where=path, remedy="cut the dataset")
            for row in table.to_pylist():
                episode = int(row["episode_index"])
                lengths[episode] = int(row.get("length") or 0)
                tasks[episode] = ", ".join(word for word in row.get("tasks") or () if isinstance(word, str))
                chunk, file = row.get("data/chunk_index"), row.get("data/file_index")
                if not standard or chunk is None or file is None:
                    continue
                name = DATA_PATH.format(chunk_index=int(chunk), file_index=int(file))
                if not (root / name).is_file():
                    raise BadInput(f"{name} is missing, with episode {episode}", where=root, remedy=REPEAT)
    return lengths, tasks


def _table(path: Path, columns: Sequence[str], width: int = 1) -> pa.Table:
    try:
        return parquet_table(path, columns, width)
    except BadInput:
        with path.open("rb") as stream:
            pointer = stream.read(len(LFS_POINTER)) == LFS_POINTER
        if pointer:
            raise BadInput("git has not brought this file yet", where=path, remedy="run `git lfs pull` there") from None
        raise


def _rows(path: Path, dataset: DatasetFacts) -> list[_Rows]:
    """The rows of a file, cut where another episode begins."""
    needed = ("episode_index", "frame_index", "timestamp", STATE, ACTION)
    table = _table(path, needed, max(len(dataset.state), len(dataset.action)))
    lacking = [name for name in needed if name not in table.column_names]
    if lacking:
        raise BadInput(f"there is no column {', '.join(lacking)}", where=path, remedy=REPEAT)
    values = {
        name: _matrix(table[name], len(names), path, name)
        for name, names in zip(needed, (("",), ("",), ("",), dataset.state, dataset.action), strict=True)
    }
    episode = values["episode_index"][:, 0]
    cuts = [0, *(np.flatnonzero(np.diff(episode)) + 1).tolist(), len(episode)]
    return [
        _Rows(
            path,
            int(episode[start]),
            values["frame_index"][start:stop, 0],
            values["timestamp"][start:stop, 0],
            values[STATE][start:stop],
            values[ACTION][start:stop],
        )
        for start, stop in itertools.pairwise(cuts)
        if stop > start
    ]


def _matrix(column: pa.ChunkedArray, width: int, path: Path, name: str) -> Array:
    """A column as (rows, width) finite numbers; a feature of one number stands there without its list."""
    where = f"{path}, column {name}"
    cells = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], pa.float64())
    if isinstance(cells, pa.ExtensionArray):
        cells = cells.storage
    if cells.null_count:
        row = int(np.flatnonzero(np.asarray(cells.is_null()))[0])
        raise BadInput(f"row {row + 1} has no value", where=where, remedy=REPEAT)
    if pa.types.is_list(cells.type) or pa.types.is_large_list(cells.type) or pa.types.is_fixed_size_list(cells.type):
        lengths = np.asarray(cells.value_lengths())
        wrong = np.flatnonzero(lengths != width)
        if len(wrong):
            raise BadInput(
                f"row {int(wrong[0]) + 1} has {int(lengths[wrong[0]])} values where meta/info.json names {width}",
                where=where,
                remedy=REPEAT,
            )
        cells = cells.flatten()
    elif width != 1 and len(cells):
        raise BadInput(f"a row has one value where meta/info.json names {width}", where=where, remedy=REPEAT)
    if not (pa.types.is_floating(cells.type) or pa.types.is_integer(cells.type)):
        raise BadInput(f"the values are {cells.type}, not numbers", where=where, remedy=REPEAT)
    numbers = np.asarray(cells.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False), float).reshape(-1, width)
    bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    if len(bad):
        value = numbers[bad[0]][~np.isfinite(numbers[bad[0]])][0]
        raise BadInput(
            f"row {int(bad[0]) + 1} holds {value}", where=where, remedy="leave that episode out of the dataset"
        )
    return numbers


def _episode(parts: Sequence[_Rows], dataset: DatasetFacts) -> DatasetEpisode:
    index = parts[0].episode
    where = f"{parts[0].path}, episode {index}"
    frame, timestamp = (np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "timestamp"))
    declared = dataset.lengths.get(index, 0)
    if declared and declared != len(frame):
        raise BadInput(f"it has {len(frame)} rows where meta/episodes says {declared}", where=where, remedy=REPEAT)
    check_time(timestamp, where)
    steps = np.diff(timestamp)
    # Neither jitter that pulls the median nor a pause that pulls the mean is another rate or unit.
    apart = (
        min((np.median(steps), np.mean(steps)), key=lambda step: abs(step * dataset.fps - 1.0)) if len(steps) else None
    )
    if apart is not None and abs(apart * dataset.fps - 1.0) > RATE_SHARE:
        raise BadInput(
            f"rows are {number(apart, 's')} apart where meta/info.json says {literal(dataset.fps)} a second",
            where=where,
            remedy="correct `fps` there; `timestamp` is in s",
        )
    # Written in 32 bits, a time of minutes is off by microseconds: where it is the frame over the rate, that is exact.
    exact = (frame - frame[0]) / dataset.fps
    elapsed = timestamp - timestamp[0]
    counted = bool((np.abs(elapsed - exact) <= IN_TIME_S + 1e-6 * elapsed).all() and (np.diff(frame) > 0.0).all())
    return DatasetEpisode(
        index,
        exact if counted else elapsed,
        np.concatenate([part.state for part in parts]),
        np.concatenate([part.action for part in parts]),
        counted,
    )
