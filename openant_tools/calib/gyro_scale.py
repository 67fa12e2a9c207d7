"""The gyro's scale: what a turn by hand and a turn that the camera saw say of it.

No message of the firmware tells how many counts a gyro has for 1 °/s. Two steps are in the field: 61.035 mdps (2000/32768
°/s, InvenSense and Bosch) and 70 mdps (ST's LSM6DSO and LSM6DSV16X). They are 12.8 % apart, more than hands err by where
a table's edge stops them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from openant_tools.numbers import number, percent

__all__ = ["KNOWN", "GyroScale", "by_camera", "by_hand", "old_rates"]

#: step of the sensor → raw counts for 1 °/s
KNOWN: Mapping[str, float] = {"61.035 mdps": 32768 / 2000, "70 mdps": 1000 / 70}
QUARTER_RAD = math.pi / 2
#: A turn by hand ends within this of a multiple of a quarter turn. Of a quarter turn the two steps make 11.5°.
HAND_RAD = math.radians(5.5)
#: Turns of more than this many quarters are not asked for.
QUARTERS = 4
#: Sensors of one step differ by 1 %, a camera that hangs askew adds as much: within this share it is that step.
SAME_SHARE = 0.03


@dataclass(frozen=True)
class GyroScale:
    """A measured scale.

    Attributes:
        counts_per_dps: raw counts for 1 °/s; the known step's own where it is one.
        low, high: what the measurement itself says, 95 %.
        step: of the sensor, in words; "" where no known sensor has it.
    """

    counts_per_dps: float
    low: float
    high: float
    step: str

    @property
    def words(self) -> str:
        of = f"a sensor of {self.step} a step" if self.step else "no known sensor's step"
        return f"{number(self.counts_per_dps, decimals=2)} counts for 1 °/s ({of})"


def by_hand(turns_rad: Sequence[float], now: float, *, measured: bool = False) -> GyroScale | None:
    """The scale that makes every turn a multiple of a quarter turn, None where none does, or several do.

    Args:
        turns_rad: what the gyro read of each turn, with the scale `now`; one at least.
        now: counts for 1 °/s that are in use.
        measured: whether those were measured: then they are believed as long as the turns do not speak against them.
    """
    candidates = dict(KNOWN)
    if measured and all(abs(now / counts - 1) > SAME_SHARE for counts in KNOWN.values()):
        candidates[""] = now
    found: dict[str, float] = {}
    spread: dict[str, tuple[float, float]] = {}
    for step, counts in candidates.items():
        each = [_off(abs(turn) * now / counts) for turn in turns_rad]
        if all(off is not None for off in each):
            offs = [off for off in each if off is not None]
            found[step] = max(abs(off) for off, _ in offs)
            low = max(counts * (1 + (off - HAND_RAD) / whole) for off, whole in offs)
            high = min(counts * (1 + (off + HAND_RAD) / whole) for off, whole in offs)
            spread[step] = low, high
    if len(found) != 1 and "" not in found:
        return None
    step = "" if "" in found else next(iter(found))
    return GyroScale(candidates[step], *spread[step], step)


def _off(turn_rad: float) -> tuple[float, float] | None:
    """How far a turn is from the nearest number of quarters, and that turn, rad; None where hands do not err so far."""
    quarters = round(turn_rad / QUARTER_RAD)
    off = turn_rad - quarters * QUARTER_RAD
    return (off, quarters * QUARTER_RAD) if 1 <= quarters <= QUARTERS and abs(off) <= HAND_RAD else None


def by_camera(scale: float, error: float, now: float) -> GyroScale:
    """The scale by the tag's heading.

    Args:
        scale, error: camera angle over gyro angle, and one standard deviation of it. now: counts for 1 °/s in use.
    """
    counts, low, high = now / scale, now / (scale + 2 * error), now / max(scale - 2 * error, 1e-9)
    step, nominal = min(KNOWN.items(), key=lambda one: abs(math.log(counts / one[1])))
    if abs(counts / nominal - 1) > max(SAME_SHARE, 2 * error / scale):
        return GyroScale(counts, low, high, "")
    return GyroScale(nominal, low, high, step)


def old_rates(before: float, now: GyroScale) -> str:
    """What a new scale means for what was recorded with the one before it (counts for 1 °/s), in words."""
    off = now.counts_per_dps / before - 1
    return f"rates that were recorded before stay as they are, {percent(abs(off), decimals=1)} {'low' if off < 0 else 'high'}"
