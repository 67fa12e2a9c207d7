"""The IMU as the engine uses it: between two cycles of the bus, turned into the body's frame, its faults told once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.clock import Clock, SteppedClock
from openant_tools.comms.imu import IMU_BAUD, Imu, ImuInfo, ImuSample
from openant_tools.comms.line import Line, SerialLine
from openant_tools.comms.messages import ImuConfig
from openant_tools.errors import HardwareFault

__all__ = ["BodyImu", "rotation"]

#: An older sample is not a measurement of this cycle.
FRESH_S = 0.05
#: What is wrong is said again after so long, if it is still wrong.
REPEAT_S = 10.0


def rotation(vector: tuple[float, ...]) -> NDArray[np.float64]:
    """The matrix of a rotation vector (3,) rad: R = I + sin θ K + (1 − cos θ) K² (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = (component / angle for component in vector)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: NDArray[np.float64] = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)
    return matrix


class BodyImu:
    """One flight controller, connected.

    Attributes:
        info: what it is, and the scales in use.
        notes: what a builder should know of it.

    Raises:
        HardwareFault: it does not answer as one.
    """

    def __init__(self, config: ImuConfig, clock: Clock) -> None:
        self._clock = clock
        self._rotation = rotation(config.mounting_rad)
        self._gyro_bias, self._acc_bias = np.array(config.gyro_bias_rad_s), np.array(config.acc_bias_m_s2)
        self._values: tuple[float, ...] = (float("nan"),) * 6
        self._t = -np.inf
        self._sample: ImuSample | None = None
        self._said: tuple[str, float] = ("", -np.inf)
        self._imu = Imu(
            lambda: self._open(config.port), clock, where=config.port,
            gyro_counts_per_dps=config.gyro_counts_per_dps, acc_counts_per_g=config.acc_counts_per_g,
        )  # fmt: skip
        self.info: ImuInfo = self._imu.connect()
        self.notes = self.info.notes

    def _open(self, port: str) -> Line:
        line = SerialLine(port, IMU_BAUD)
        if isinstance(self._clock, SteppedClock):
            self._clock.attach(imu=line)
        return line

    @property
    def taken_at(self) -> float:
        """s, when the last sample was taken; NaN before the first."""
        return self._t if self._sample is not None else float("nan")

    @property
    def lean(self) -> tuple[float, float, float] | None:
        """(t, roll, pitch) of the body by the flight controller's own estimate, rad; None where it has none."""
        sample = self._sample
        if sample is None or sample.attitude_t is None or sample.roll is None or sample.pitch is None:
            return None
        # Up, seen from the sensor and then from the body: roll about x after pitch about y (ISO 8855 angles).
        sr, cr, sp, cp = np.sin(sample.roll), np.cos(sample.roll), np.sin(sample.pitch), np.cos(sample.pitch)
        x, y, z = (self._rotation @ np.array([-sp, cp * sr, cp * cr])).tolist()
        return sample.attitude_t, float(np.arctan2(y, z)), float(-np.arcsin(np.clip(x, -1.0, 1.0)))

    def until(self, deadline: float) -> Iterator[tuple[float, list[float], list[float]]]:
        """Samples (t, gyro rad/s, acc m/s²) in the body's frame as they come, until the deadline."""
        while self._clock.now() < deadline:
            try:
                sample = self._imu.read(deadline)
            except HardwareFault:
                return  # none by the deadline; `news` knows whether that matters
            gyro = (self._rotation @ sample.gyro - self._gyro_bias).tolist()
            acc = (self._rotation @ sample.acc - self._acc_bias).tolist()
            self._sample = sample
            self._values, self._t = (*gyro, *acc), sample.t
            yield sample.t, gyro, acc

    def newest(self, t: float) -> tuple[float, ...]:
        """Gyro and acceleration (6,) for a cycle at `t`; NaN where the last sample is old."""
        return self._values if t - self._t < FRESH_S else (float("nan"),) * 6

    def news(self) -> str | None:
        """What is wrong with it, once when it begins and from time to time while it lasts."""
        fault = self._imu.fault()
        if fault is None:
            self._said = ("", -np.inf)
            return None
        kind, now = fault.what[:30], self._clock.now()
        if kind == self._said[0] and now - self._said[1] < REPEAT_S:
            return None
        self._said = (kind, now)
        return str(fault)

    def close(self) -> None:
        self._imu.close()
