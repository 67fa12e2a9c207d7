"""Runs as a LeRobot dataset (v3.0), an episode each: positions measured and commanded, in degrees as LeRobot has them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.exchange.card import card
from openant_tools.exchange.lerobot_dataset import ACTION, DATA_PATH, STATE
from openant_tools.exchange.source import Source, read_source
from openant_tools.files import atomic_writer, json_text, write_text
from openant_tools.numbers import literal
from openant_tools.optional import pa, pq
from openant_tools.recording.run import Array, Run

__all__ = ["write_lerobot"]

#: a further feature → the columns that it has, in SI; left out where a run has none of them
MORE: Mapping[str, tuple[str, ...]] = {
    "observation.imu": tuple(f"{kind}.{axis}" for kind in ("gyro", "acc") for axis in "xyz"),
    "observation.base": ("base.x", "base.y", "base.z", "base.yaw"),
}
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def write_lerobot(paths: Sequence[Path], out: Path, fps: float | None = None) -> tuple[int, int]:
    """Write runs as one dataset into `out`; returns how many episodes and frames it has.

    LeRobot knows no times but frame over rate: rows are taken on such a grid, measurements interpolated between the
    samples on both sides, commands as they were in force.

    Args:
        fps: frames a second; default: the first run's own rate, rounded.

    Raises:
        BadInput: a run has no commands or positions, or other joints than the first; there is a dataset already.
    """
    if (out / "meta" / "info.json").exists():
        raise BadInput("there is a dataset already", where=out, remedy="name another folder with --out")
    sources = [read_source(path, draw=False) for path in paths]
    joints = sources[0].run.joints
    for one, path in zip(sources, paths, strict=True):
        if not one.run.has("cmd") or not one.run.has("pos"):
            raise BadInput(
                "it has no commands, or no positions", where=path, remedy="export a run that moved the robot"
            )
        if one.run.joints != joints:
            raise BadInput(
                f"its joints are others ({', '.join(one.run.joints)})", where=path, remedy="export runs of one robot"
            )
    rate = fps or max(1, round(1.0 / float(np.median(np.diff(sources[0].run.t)))))
    more = {name: columns for name, columns in MORE.items() if all(_all_have(one.run, columns) for one in sources)}
    named = {ACTION: [f"{joint}.pos" for joint in joints], STATE: [f"{joint}.pos" for joint in joints]}
    named |= {name: list(columns) for name, columns in more.items()}
    episodes = [_frames(one.run, rate, more) for one in sources]
    tasks = list(dict.fromkeys(_task(one.run) for one in sources))
    table, listed = _rows(sources, episodes, tasks, rate)
    for place, part in ((DATA_PATH.format(chunk_index=0, file_index=0), table), (EPISODES, listed)):
        with atomic_writer(out / place) as stream:
            pq.write_table(part, stream)
    with atomic_writer(out / "meta" / "tasks.parquet") as stream:
        pq.write_table(_tasks(tasks), stream)
    whole = {name: np.concatenate([one[name] for one in episodes]) for name in named}
    write_text(out / "meta" / "stats.json", json_text({name: _statistics(values) for name, values in whole.items()}))
    write_text(
        out / "meta" / "info.json", json_text(_info(named, len(table), len(episodes), len(tasks), rate), indent=4)
    )
    runs = [f"episode {k}: `{one.run.name}`, {len(episodes[k][ACTION])} frames" for k, one in enumerate(sources)]
    notes = [
        f"rows are frames of 1/{literal(rate)} s: measurements are interpolated, commands are those in force",
        f"`{ACTION}` and `{STATE}` are joint angles in degrees; the rest is in SI units (rad/s, m/s², m, rad)",
    ]
    folder = next((one.folder for one in sources if one.folder is not None), None)
    write_text(out / "README.md", card(f"{out.name}, a LeRobot dataset", folder, runs, notes))
    return len(episodes), len(table)


def _all_have(run: Run, columns: Sequence[str]) -> bool:
    return all(name in run.columns and np.isfinite(run.column(name)).any() for name in columns)


def _task(run: Run) -> str:
    return run.facts.protocol or run.name


def _frames(run: Run, rate: float, more: Mapping[str, Sequence[str]]) -> dict[str, Array]:
    t = np.arange(run.t[0], run.t[-1] + 1e-9, 1.0 / rate)
    command_t = run.command_times
    out = {
        ACTION: np.degrees(np.array([_in_force(t, command_t, run.column(f"cmd.{joint}")) for joint in run.joints]).T),
        STATE: np.degrees(np.array([_between(t, run.t, run.column(f"pos.{joint}")) for joint in run.joints]).T),
    }
    return out | {
        name: np.array([_between(t, run.t, run.column(one)) for one in columns]).T for name, columns in more.items()
    }


def _in_force(t: Array, since: Array, values: Array) -> Array:
    good = np.isfinite(values)
    return np.asarray(values[good][np.clip(np.searchsorted(since[good], t, "right") - 1, 0, None)])


def _between(t: Array, at: Array, values: Array) -> Array:
    good = np.isfinite(values)
    return np.interp(t, at[good], values[good])


def _rows(
    sources: Sequence[Source], episodes: Sequence[Mapping[str, Array]], tasks: Sequence[str], rate: float
) -> tuple[pa.Table, pa.Table]:
    """All frames, and a row an episode on where they are, with its statistics."""
    lengths = np.array([len(one[ACTION]) for one in episodes])
    frame = np.concatenate([np.arange(n) for n in lengths])
    columns: dict[str, Any] = {}
    for name in episodes[0]:
        values = np.concatenate([one[name] for one in episodes]).astype(np.float32)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    whose = [tasks.index(_task(one.run)) for one in sources]
    columns |= {
        "timestamp": pa.array((frame / rate).astype(np.float32)), "frame_index": pa.array(frame),
        "episode_index": pa.array(np.repeat(np.arange(len(lengths)), lengths)), "index": pa.array(np.arange(len(frame))),
        "task_index": pa.array(np.repeat(whose, lengths)),
    }  # fmt: skip
    ends = np.cumsum(lengths)
    zeros = [0] * len(lengths)
    listed: dict[str, Any] = {
        "episode_index": list(range(len(lengths))), "tasks": [[tasks[k]] for k in whose], "length": lengths.tolist(),
        "data/chunk_index": zeros, "data/file_index": zeros, "dataset_from_index": (ends - lengths).tolist(),
        "dataset_to_index": ends.tolist(), "meta/episodes/chunk_index": zeros, "meta/episodes/file_index": zeros,
    }  # fmt: skip
    for name in episodes[0]:
        for kind in ("min", "max", "mean", "std", "count"):
            listed[f"stats/{name}/{kind}"] = [_statistics(one[name])[kind] for one in episodes]
    return pa.table(columns), pa.table(listed)


def _statistics(values: Array) -> dict[str, list[float]]:
    return {
        "min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist(), "mean": values.mean(axis=0).tolist(),
        "std": values.std(axis=0).tolist(), "count": [len(values)],
    }  # fmt: skip


def _tasks(tasks: Sequence[str]) -> pa.Table:
    """LeRobot reads this by pandas, with the words as the index."""
    index = "__index_level_0__"
    described = {
        "index_columns": [index], "column_indexes": [], "pandas_version": "2.2.0",
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None},
            {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
    }  # fmt: skip
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _info(named: Mapping[str, Sequence[str]], frames: int, episodes: int, tasks: int, rate: float) -> dict[str, Any]:
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(columns)], "names": list(columns)} for name, columns in named.items()
    }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "codebase_version": "v3.0", "robot_type": "openant", "total_episodes": episodes, "total_frames": frames,
        "total_tasks": tasks, "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
        "fps": int(rate) if float(rate).is_integer() else rate, "splits": {"train": f"0:{episodes}"}, "data_path": DATA_PATH,
        "video_path": None, "features": features,
    }  # fmt: skip
