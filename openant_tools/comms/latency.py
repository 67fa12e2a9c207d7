"""The camera's latency, scale and the gyro's drift, from a robot that turns to and fro under the camera.

The camera's heading and the integral of the gyro's z are the same motion. With camera stamps t (arrival times, or
whatever is to be corrected) the model is

    yaw_camera(t) = offset + drift·t + scale · ∫gyro_z (t − latency)

and its four numbers are fitted by Gauss–Newton. Only changes of speed tell a latency from an offset: a steady turn
does not, and is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import number

__all__ = ["LatencyEstimate", "camera_latency"]

Array = NDArray[np.float64]

#: poses that are needed, and s of latency up to which one is looked for
MIN_FRAMES = 20
MAX_LATENCY_S = 0.5
#: The fit knows nothing of what makes neighbouring pictures err alike: its interval is widened by this.
HONESTY = 2.0


@dataclass(frozen=True)
class LatencyEstimate:
    """What the turning told.

    Attributes:
        latency_s, latency_error_s: how much older than its stamp a picture is, and one standard deviation.
        scale, scale_error: camera angle over gyro angle; 1 where the gyro's scale is right.
        drift_rad_s: camera rate minus gyro rate at rest: minus the gyro's bias.
        residual_rad: root mean square of what the model leaves.
        frames: pictures used.
    """

    latency_s: float
    latency_error_s: float
    scale: float
    scale_error: float
    drift_rad_s: float
    residual_rad: float
    frames: int


def camera_latency(camera_t: Array, camera_yaw: Array, gyro_t: Array, gyro_z: Array) -> LatencyEstimate:
    """Latency of camera stamps against gyro stamps.

    Args:
        camera_t, camera_yaw: (n,) s and rad, in any branch of the angle; pictures in which the robot was found.
        gyro_t, gyro_z: (m,) s and rad/s about the body's vertical.

    Raises:
        BadInput: too few pictures, no overlap in time, or a motion that cannot tell.
    """
    order = np.argsort(gyro_t)
    tg, rate = np.asarray(gyro_t, float)[order], np.asarray(gyro_z, float)[order]
    if len(tg) < 2:
        raise BadInput("there are no gyro readings")
    angle = np.concatenate([[0.0], np.cumsum(np.diff(tg) * (rate[1:] + rate[:-1]) / 2)])
    tc = np.asarray(camera_t, float)
    inside = (tc > tg[0] + MAX_LATENCY_S) & (tc < tg[-1])
    tc, yaw = tc[inside], np.unwrap(np.asarray(camera_yaw, float)[inside])
    if len(tc) < MIN_FRAMES:
        raise BadInput(
            f"only {len(tc)} pictures with the robot's tag lie within the gyro's record",
            remedy=f"{MIN_FRAMES} are needed: record for longer, with the tag in view",
        )
    speed = np.interp(tc, tg, rate)
    if np.ptp(speed) < 0.5 or np.ptp(yaw) < math.radians(10):
        raise BadInput(
            f"the robot turned by {number(float(np.ptp(yaw)), 'rad')} with its speed changing by "
            f"{number(float(np.ptp(speed)), 'rad/s')}, which tells no latency",
            remedy="turn it to and fro by hand, 30° and more, about once a second",
        )
    middle = tc.mean()

    def linear(latency: float) -> tuple[Array, float]:
        """Offset, drift and scale for a latency, and the sum of squares they leave."""
        matrix = np.column_stack([np.ones_like(tc), tc - middle, np.interp(tc - latency, tg, angle)])
        solution = np.linalg.lstsq(matrix, yaw, rcond=None)[0]
        return np.asarray(solution, float), float(np.sum((yaw - matrix @ solution) ** 2))

    grid = np.arange(-0.05, MAX_LATENCY_S, 0.01)
    latency = float(grid[int(np.argmin([linear(g)[1] for g in grid]))])
    step = 0.01
    while step > 1e-6:  # golden section would do; the valley is smooth and one number wide
        values = [linear(latency + d)[1] for d in (-step, 0.0, step)]
        best = int(np.argmin(values))
        latency += (best - 1) * step
        if best == 1:
            step /= 2
    solution, left = linear(latency)
    jacobian = np.column_stack(
        [
            np.ones_like(tc),
            tc - middle,
            np.interp(tc - latency, tg, angle),
            -solution[2] * np.interp(tc - latency, tg, rate),
        ]
    )
    variance = left / max(1, len(tc) - 4)
    errors = HONESTY * np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
    return LatencyEstimate(
        latency_s=latency,
        latency_error_s=float(errors[3]),
        scale=float(solution[2]),
        scale_error=float(errors[2]),
        drift_rad_s=float(solution[1]),
        residual_rad=math.sqrt(left / len(tc)),
        frames=len(tc),
    )
