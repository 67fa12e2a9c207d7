"""A picture of a robot from its MJCF: rendered where there is OpenGL, else drawn from the places of its parts."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["draw", "render", "robot_picture"]

Array = NDArray[np.float64]

#: where the camera stands, as the portraits of the nominal model have it
AZIMUTH_DEG, ELEVATION_DEG, DISTANCE_M = 158.0, -31.0, 0.74
WIDTH, HEIGHT = 960, 600
#: around a drawn robot
MARGIN_M = 0.05


def robot_picture(model_path: Path) -> tuple[bytes | None, str]:
    """A PNG of the robot at its home pose, and how it was made; None and why not, where neither way works.

    Raises:
        BadInput: the model cannot be read.
    """
    from openant_env.rendering import NoOpenGL
    from openant_tools.model.plant import Setup, load_plant

    model = load_plant(model_path, None, Setup.FLOOR, drawn=True).model
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    try:
        return render(model, data), "rendered"
    except NoOpenGL:
        pass
    try:
        return draw(model, data), "drawn from its parts, for there is no OpenGL here"
    except Exception as error:  # a picture is never worth a failed report, whatever matplotlib lacks
        return None, f"no picture of the robot: {error}"


def render(model: mujoco.MjModel, data: mujoco.MjData) -> bytes:
    """A PNG by MuJoCo's renderer; raises NoOpenGL where there is none."""
    from matplotlib.image import imsave

    from openant_env.rendering import Painter

    painter = Painter(model, WIDTH, HEIGHT)
    try:
        x, y, _ = data.subtree_com[1]
        pixels = painter.frame(
            data,
            look_at=(float(x), float(y), 0.09),
            azimuth_deg=AZIMUTH_DEG,
            elevation_deg=ELEVATION_DEG,
            distance_m=DISTANCE_M,
        )
    finally:
        painter.close()
    buffer = io.BytesIO()
    imsave(buffer, pixels, format="png")
    return buffer.getvalue()


def draw(model: mujoco.MjModel, data: mujoco.MjData) -> bytes:
    """A PNG by matplotlib: capsules and cylinders as thick lines, spheres as discs, the nearest last."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    right, up, forward = _camera_axes()
    pieces = sorted(_pieces(model, data), key=lambda piece: -float(piece.ends.mean(axis=0) @ forward))
    if not pieces:
        raise ValueError("the model has no capsules or spheres to draw")
    across = np.array([piece.ends @ right for piece in pieces])
    high = np.array([piece.ends @ up for piece in pieces])
    figure = Figure(figsize=(WIDTH / 150, HEIGHT / 150))
    axes: Any = figure.add_axes((0, 0, 1, 1))
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_xlim(across.min() - MARGIN_M, across.max() + MARGIN_M)
    axes.set_ylim(high.min() - MARGIN_M, high.max() + MARGIN_M)
    # Widths of lines are in points: how many of them a metre is here.
    points = min(
        72 * figure.get_figwidth() / (np.ptp(across) + 2 * MARGIN_M),
        72 * figure.get_figheight() / (np.ptp(high) + 2 * MARGIN_M),
    )
    for order, (piece, x, z) in enumerate(zip(pieces, across, high, strict=True)):
        for size, shade in ((1.06, 0.6), (1.0, 1.0)):
            colour = np.clip(shade * piece.rgb, 0.0, 1.0)
            if piece.round:
                axes.add_patch(Circle((x[0], z[0]), size * piece.radius, color=colour, linewidth=0, zorder=order))
            else:
                width = 2 * piece.radius * points * size
                axes.plot(x, z, color=colour, linewidth=width, solid_capstyle="round", zorder=order)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, facecolor="white")
    return buffer.getvalue()


@dataclass(frozen=True)
class _Piece:
    """A part of the robot: (2, 3) m, its ends; m, its radius; its colour; whether it is a sphere."""

    ends: Array
    radius: float
    rgb: Array
    round: bool


def _pieces(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[_Piece]:
    """The round geoms and the sites that can be seen, in the world as `data` has it."""
    for i in range(model.ngeom):
        kind = mujoco.mjtGeom(int(model.geom_type[i]))
        if kind not in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE):
            continue
        is_sphere = kind == mujoco.mjtGeom.mjGEOM_SPHERE
        half = 0.0 if is_sphere else float(model.geom_size[i, 1])
        along = half * data.geom_xmat[i].reshape(3, 3)[:, 2]
        material = int(model.geom_matid[i])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[i]
        ends = np.array([data.geom_xpos[i] - along, data.geom_xpos[i] + along])
        yield _Piece(ends, float(model.geom_size[i, 0]), rgba[:3], is_sphere)
    for i in range(model.nsite):
        if model.site_rgba[i, 3] > 0:
            place = data.site_xpos[i]
            yield _Piece(np.array([place, place]), float(model.site_size[i, 0]), model.site_rgba[i, :3], True)


def _camera_axes() -> Any:
    """Right, up and forward of the camera in the world."""
    azimuth, elevation = np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward
