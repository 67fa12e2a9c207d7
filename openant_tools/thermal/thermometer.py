"""Temperatures as servos report them, and single answers that cannot be one.

The sensor sits in the case, which takes minutes to warm and reports whole °C. A reading that leaves its neighbours by
more than a few K and comes back is an error of telemetry (a byte lost on the bus, a reset), not heat.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["GLITCH_K", "Cleaned", "Thermometer", "clean"]

Array = NDArray[np.float64]

#: K between two neighbouring readings that heat does not explain: a stalled XM430 gains 0.1 K a second at its case.
GLITCH_K = 4.0
#: s over which a reading may go on from the last good one at `FASTEST_K_S` before it is doubted
FASTEST_K_S = 0.5
#: readings on which a level that jumped is believed: the servo was changed, or it was silent for long
BELIEVED = 4


@dataclass(frozen=True)
class Cleaned:
    """Temperatures without telemetry errors.

    Attributes:
        values: (n,) °C, NaN where there is no reading or a wrong one.
        glitches: rows that were taken out.
    """

    values: Array
    glitches: NDArray[np.intp]


@dataclass
class Thermometer:
    """The same decision one reading at a time, for whoever must stop a servo: it is late by no good reading.

    Attributes:
        value: the last good reading, °C; NaN before the first.
        glitches: how many were left out.
    """

    value: float = float("nan")
    glitches: int = 0
    _t: float = 0.0
    _doubted: deque[float] = field(default_factory=lambda: deque(maxlen=BELIEVED))

    def read(self, t: float, reading: float) -> float:
        """Take a reading (°C, NaN for none) at `t` (s); the temperature as it is known then."""
        if reading != reading:
            return self.value
        reach = GLITCH_K + FASTEST_K_S * max(0.0, t - self._t)
        if self.value == self.value and abs(reading - self.value) > reach:
            self._doubted.append(reading)
            spread = max(self._doubted) - min(self._doubted)
            if len(self._doubted) < BELIEVED or spread > GLITCH_K:
                self.glitches += 1
                return self.value
            self.glitches -= BELIEVED - 1
        elif self.value != self.value and not self._doubted:
            # Nothing to compare the very first reading with: the second one says.
            self._doubted.append(reading)
            return self.value
        elif self.value != self.value and abs(reading - self._doubted[-1]) > GLITCH_K:
            self._doubted.append(reading)
            self.glitches += 1
            return self.value
        self._doubted.clear()
        self.value, self._t = reading, t
        return self.value


def clean(t: Array, reading: Array) -> Cleaned:
    """Take single-sample errors out of (n,) readings (°C) at (n,) s.

    A reading is wrong where it differs from the median of its five neighbours in time by more than heat explains.
    """
    values = np.asarray(reading, float).copy()
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) < 3:
        return Cleaned(values, np.zeros(0, np.intp))
    seen, when = values[rows], np.asarray(t, float)[rows]
    padded = np.pad(seen, 2, mode="edge")
    # The ends have neighbours on one side only: there the median of the nearest five.
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5).copy()
    if len(seen) >= 5:
        windows[:2], windows[-2:] = seen[:5], seen[-5:]
    middle = np.median(windows, axis=1)
    apart = np.gradient(when) if len(when) > 1 else np.ones(1)
    wrong = np.abs(seen - middle) > GLITCH_K + FASTEST_K_S * 2 * apart
    glitches = rows[wrong]
    values[glitches] = np.nan
    return Cleaned(values, glitches)
