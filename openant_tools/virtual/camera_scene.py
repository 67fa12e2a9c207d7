"""What the overhead camera is and what it sees, without any picture: the settings of a scenario, and a scene.

Frames as in `overhead_camera`, which draws it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.intrinsics import Intrinsics

__all__ = ["OverheadCameraSettings", "Scene", "TagOnFloor", "TagOnRobot"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TagOnFloor:
    """The origin tag: `size` is its edge length in m; position and yaw of its up-direction in the world.

    By default it lies where the platform's arena has it: the middle, where the robot starts, is at (0.75, −0.30) in its
    frame (facts/robot.md, section 5).
    """

    family: str = "tagCircle21h7"
    id: int = 0
    size: float = 0.10
    x: float = -0.75
    y: float = 0.30
    yaw: float = 0.0


@dataclass(frozen=True)
class TagOnRobot:
    """The body tag: `position` of its centre in the body, m; `yaw` of its up-direction against the body's x axis."""

    family: str = "tagCircle21h7"
    id: int = 12
    size: float = 0.045
    position: tuple[float, float, float] = (0.0, 0.0, 0.085)
    yaw: float = 0.0


@dataclass(frozen=True)
class OverheadCameraSettings:
    """What a scenario may set of the camera (`[camera]`).

    Attributes:
        width, height, fps: of the pictures.
        fov_diagonal_deg, centre_px, distortion: of the lens; `centre_px` is the principal point's offset, px.
        position, look_at: m in the world. up_yaw: direction in the floor that is up in the picture, rad.
        exposure_s, blur_px, noise: shutter time; standard deviation of the lens' blur, px; of the noise, grey levels.
        brightness: grey level of white paper. flicker: its relative swing at twice the mains frequency.
        vignette: how much darker the corners are.
        latency_s, latency_jitter_s: from the middle of the exposure to the picture's delivery.
        drop: share of frames that are lost. jpeg_quality: of the stream.
        bare: the robot is drawn as its tag alone.
    """

    width: int = 1280
    height: int = 720
    fps: float = 30.0
    fov_diagonal_deg: float = 60.0
    centre_px: tuple[float, float] = (6.0, -4.0)
    distortion: tuple[float, float, float, float, float] = (0.06, -0.12, 0.0006, -0.0004, 0.0)
    position: tuple[float, float, float] = (0.0, 0.0, 2.0)
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up_yaw: float = math.pi / 2
    exposure_s: float = 0.008
    blur_px: float = 0.7
    noise: float = 2.5
    brightness: float = 225.0
    flicker: float = 0.03
    vignette: float = 0.25
    latency_s: float = 0.07
    latency_jitter_s: float = 0.004
    drop: float = 0.0
    jpeg_quality: int = 88
    origin: TagOnFloor | None = field(default_factory=TagOnFloor)
    body: TagOnRobot | None = field(default_factory=TagOnRobot)
    bare: bool = False

    @property
    def intrinsics(self) -> Intrinsics:
        """The lens as it is."""
        pinhole = Intrinsics.from_diagonal_fov(self.width, self.height, self.fov_diagonal_deg)
        cx, cy = pinhole.cx + self.centre_px[0], pinhole.cy + self.centre_px[1]
        return Intrinsics(self.width, self.height, pinhole.fx, pinhole.fy, cx, cy, self.distortion, "scenario")


@dataclass(frozen=True)
class Scene:
    """What moves, at one instant.

    Attributes:
        position: of the body's origin in the world, m. rotation: 3 × 3, world from body.
        limbs: capsules in the world, each (ax, ay, az, bx, by, bz, radius), m.
        torso_radius: m.
        velocity, rate: of the body, world axes, m/s and rad/s; they make motion blur.
        there: whether there is a robot to be seen; loose motors lie in their box, beside the picture.
    """

    position: Array
    rotation: Array
    limbs: Sequence[Sequence[float]] = ()
    torso_radius: float = 0.075
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    rate: Sequence[float] = (0.0, 0.0, 0.0)
    there: bool = True

    def moved(self, dt: float) -> Scene:
        """The scene `dt` later, as a rigid body that goes on as it does."""
        turn = _turned(np.asarray(self.rate, float) * dt)
        centre = np.asarray(self.position, float)
        shift = centre + np.asarray(self.velocity, float) * dt
        limbs = np.array(self.limbs, float).reshape(-1, 7)
        for ends in (slice(0, 3), slice(3, 6)):
            limbs[:, ends] = (limbs[:, ends] - centre) @ turn.T + shift
        return replace(self, position=shift, rotation=turn @ np.asarray(self.rotation, float), limbs=limbs.tolist())


def _turned(w: Array) -> Array:
    """The rotation about `w` by its length, rad (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = w / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return turn
