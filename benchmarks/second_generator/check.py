"""`--check`: a healthy and an ill robot of the same scatter, and what has to differ between them."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from answer import Answer, Effect

__all__ = ["check"]

DELAY_S, TILT_RAD = 0.04, 0.08
#: one whose tables are Parquet, with an IMU
SEED = 9


def _read(folder: Path, setup: str) -> dict[str, np.ndarray]:
    table = pq.read_table(next(folder.glob(f"{setup}_*.parquet")))
    return {name: table[name].to_numpy(zero_copy_only=False).astype(float) for name in table.column_names}


def _lag(one: dict[str, np.ndarray], other: dict[str, np.ndarray], column: str) -> float:
    """s by which a column comes later in the other: where the two lie best upon each other."""
    lags = np.arange(-0.01, 0.08, 0.0005)
    t = one["t"][(one["t"] > 0.2) & (one["t"] < one["t"][-1] - 0.2)]
    reference = np.interp(t, one["t"], one[column])
    errors = [np.mean((np.interp(t + lag, other["t"], other[column]) - reference) ** 2) for lag in lags]
    return float(lags[int(np.argmin(errors))])


def check(model: Path, make: Callable[..., None]) -> int:
    """Print what was measured and what was asked; 1 where they disagree."""
    healthy = Answer("healthy", model, SEED, True)
    delay = Effect("action_delay", ("knee_fl",), {"delay_s": DELAY_S})
    tilt = Effect("floor_tilt", "body", {"angle_rad": TILT_RAD, "direction": 0.3})
    with tempfile.TemporaryDirectory() as place:
        folders = [Path(place) / name for name in ("healthy", "ill")]
        for folder, answer in zip(folders, (healthy, Answer("ill", model, SEED, True, (delay, tilt))), strict=True):
            folder.mkdir()
            make(answer, folder, short=True)
        stand, floor = ([_read(folder, setup) for folder in folders] for setup in ("stand", "floor"))
        knees = [name for name in stand[0] if name.startswith("pos.")]
        (late,) = [name for name in knees if "fl" in name.lower() and ("knee" in name or "pitch" in name)]
    lags = {name: _lag(*stand, name) for name in knees}
    following = np.sqrt(np.mean([np.mean((stand[0][k] - stand[0][k.replace("pos.", "cmd.")]) ** 2) for k in knees]))
    across = [float(np.hypot(run["acc.x"][5:25].mean(), run["acc.y"][5:25].mean())) for run in floor]
    rows = [
        ("a late knee, s", lags[late], DELAY_S - 0.006, DELAY_S + 0.006),
        ("the latest of the others, s", max(abs(v) for k, v in lags.items() if k != late), 0.0, 0.002),
        ("rms of position against command, rad", float(following), 0.02, 0.25),
        ("height of the torso, m", float(np.nanmedian(floor[0]["base.z"])), 0.12, 0.17),
        ("across in the accelerometer, healthy, m/s²", across[0], 0.0, 0.3),
        ("and on a slope, m/s²", across[1], 9.81 * math.sin(TILT_RAD) - 0.3, 9.81 * math.sin(TILT_RAD) + 0.3),
        ("shortest step of t, s", float(min(np.diff(run["t"]).min() for run in (*stand, *floor))), 1e-6, 0.05),
    ]
    for words, value, low, high in rows:
        print(f"{'ok ' if low <= value <= high else 'BAD'} {words}: {value:.4g} (asked {low:.4g} … {high:.4g})")
    return 0 if all(low <= value <= high for _, value, low, high in rows) else 1
