"""LeRobot datasets as LeRobot 0.4 lays them out, small; and its arithmetic from counts to what it writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

JOINTS = ("shoulder_pan", "elbow_flex", "gripper")
#: the middle of the elbow's range lies between two counts; the gripper's sign is turned
CALIBRATION = {
    "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": 117, "range_min": 746, "range_max": 3430},
    "elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": -40, "range_min": 851, "range_max": 3070},
    "gripper": {"id": 6, "drive_mode": 1, "homing_offset": 9, "range_min": 2031, "range_max": 3500},
}
TURN = 4096


def written(counts: NDArray[Any], entry: Mapping[str, int], mode: str) -> NDArray[Any]:
    """What LeRobot's Feetech bus makes of raw positions."""
    low, high = entry["range_min"], entry["range_max"]
    if mode == "degrees":
        return (counts - (low + high) / 2) * 360 / (TURN - 1)
    share = (np.clip(counts, low, high) - low) / (high - low)
    if mode == "percent":
        return np.asarray(100 - 100 * share if entry["drive_mode"] else 100 * share)
    return np.asarray((200 * share - 100) * (-1 if entry["drive_mode"] else 1))


def counts_of(rows: int, joint: int, entry: Mapping[str, int], phase: float = 0.0) -> NDArray[Any]:
    """Raw positions of a slow swing through three quarters of the range."""
    middle, half = (entry["range_min"] + entry["range_max"]) / 2, (entry["range_max"] - entry["range_min"]) / 2
    return np.asarray(np.round(middle + 0.75 * half * np.sin(np.arange(rows) * 0.1 * (joint + 1) + phase)))


def angles(counts: NDArray[Any], entry: Mapping[str, int]) -> NDArray[Any]:
    return (counts - (entry["range_min"] + entry["range_max"]) / 2) * 2 * np.pi / TURN


def make(
    root: Path,
    *,
    mode: str = "degrees",
    lengths: Sequence[int] = (30, 40, 20),
    files: Sequence[Sequence[int]] = ((0, 1), (2,)),
    fps: float = 30,
    joints: Sequence[str] = JOINTS,
    info: Mapping[str, Any] | None = None,
    column: Mapping[str, Any] | None = None,
    list_type: Any = None,
) -> Path:
    """Write a dataset of `lengths` rows an episode, its episodes spread over `files`; `info` and `column` replace what stands there."""
    names = [f"{joint}.pos" for joint in joints]
    feature = {"dtype": "float32", "shape": [len(names)], "names": names}
    said: dict[str, Any] = {
        "codebase_version": "v3.0", "robot_type": "so101_follower", "total_episodes": len(lengths), "total_frames": sum(lengths),
        "total_tasks": 1, "chunks_size": 1000, "fps": fps, "splits": {"train": f"0:{len(lengths)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {"action": feature, "observation.state": feature},
    }  # fmt: skip
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta" / "info.json").write_text(json.dumps(said | dict(info or {}), indent=4))
    listed: dict[str, list[Any]] = {
        name: [] for name in ("episode_index", "length", "tasks", "data/chunk_index", "data/file_index")
    }
    for number, inside in enumerate(files):
        path = root / f"data/chunk-000/file-{number:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        rows: dict[str, list[Any]] = {
            name: [] for name in ("action", "observation.state", "timestamp", "frame_index", "episode_index")
        }
        for episode in inside:
            count = lengths[episode]
            for name, phase in (("observation.state", 0.0), ("action", 0.2)):
                values = [
                    written(
                        counts_of(count, k, CALIBRATION[joint], phase + episode),
                        CALIBRATION[joint],
                        "percent" if joint == "gripper" else mode,
                    )
                    for k, joint in enumerate(joints)
                ]
                rows[name] += np.stack(values, axis=1).astype(np.float32).tolist()
            rows["timestamp"] += (np.arange(count) / fps).astype(np.float32).tolist()
            rows["frame_index"] += list(range(count))
            rows["episode_index"] += [episode] * count
            for name, value in zip(listed, (episode, count, [f"swing {episode}"], 0, number), strict=True):
                listed[name].append(value)
        lists = list_type or pa.list_(pa.float32())
        table: dict[str, Any] = {
            name: pa.array(values, lists if name in ("action", "observation.state") else None)
            for name, values in rows.items()
        }
        pq.write_table(pa.table(table | dict(column or {})), path, write_page_checksum=True)
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(listed), path)
    return root


def calibrate(folder: Path, **changes: Any) -> Path:
    """A calibration file; a joint set to None is left out, one set to a mapping has its keys changed."""
    entries = {
        joint: entry | changes.get(joint, {})
        for joint, entry in CALIBRATION.items()
        if changes.get(joint, {}) is not None
    }
    path = folder / "arm.json"
    path.write_text(json.dumps(entries, indent=4))
    return path
