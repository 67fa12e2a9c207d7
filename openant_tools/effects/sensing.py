"""What sensors tell that is not so: an IMU that reads something at rest, a tracker of another scale, heading and time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["SensingEffects"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensingEffects:
    """`imu_bias` and `tracker_scale`.

    Attributes:
        gyro_bias, acc_bias: (3,) rad/s and m/s², in the body's frame, added to what the IMU reads.
        scale: of the tracker's positions. yaw_rad: by which it turns positions and headings. latency_s: how old they are.
    """

    gyro_bias: Array
    acc_bias: Array
    scale: float = 1.0
    yaw_rad: float = 0.0
    latency_s: float = 0.0

    @property
    def tracks_wrong(self) -> bool:
        """Whether the tracker tells anything but the truth."""
        return self.scale != 1.0 or self.yaw_rad != 0.0 or self.latency_s > 0.0

    def tracked(self, x: float, y: float, hx: float, hy: float) -> tuple[float, float, float, float]:
        """Position (m) and heading (unit vector) as the tracker tells them."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return (
            self.scale * (c * x - s * y),
            self.scale * (s * x + c * y),
            c * hx - s * hy,
            s * hx + c * hy,
        )
