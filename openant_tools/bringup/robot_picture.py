"""A picture of a robot from its MJCF: rendered where there is OpenGL, else drawn from the places of its parts."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

__all__ = ["draw", "render", "robot_picture"]

#: where the camera stands, as the portraits of the nominal model have it
AZIMUTH_DEG, ELEVATION_DEG, DISTANCE_M = 148.0, -24.0, 0.78
WIDTH, HEIGHT = 960, 600


def robot_picture(model_path: Path) -> tuple[bytes | None, str]:
    """A PNG of the robot at its home pose, and how it was made; None and why not, where neither way works.

    Raises:
        BadInput: the model cannot be read.
    """
    from openant_env.rendering import NoOpenGL
    from openant_tools.model.plant import Setup, load_plant

    model = load_plant(model_path, None, Setup.FLOOR).model
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
    """A PNG by matplotlib: capsules as thick lines, spheres as balls, the nearest last."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / 150, HEIGHT / 150))
    axes: Any = figure.add_axes((0, 0, 1, 1))
    right, up, forward = _camera_axes()
    places = []
    for geom in range(model.ngeom):
        kind = model.geom_type[geom]
        if kind not in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE):
            continue
        centre = data.geom_xpos[geom]
        along = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        half = 0.0 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else float(model.geom_size[geom, 1])
        ends = np.array([centre - half * along, centre + half * along])
        material = int(model.geom_matid[geom])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        places.append((float(centre @ forward), ends @ right, ends @ up, float(model.geom_size[geom, 0]), rgba[:3]))
    axes.set_aspect("equal")
    axes.axis("off")
    across = np.concatenate([x for _, x, _, _, _ in places])
    high = np.concatenate([z for _, _, z, _, _ in places])
    axes.set_xlim(across.min() - 0.05, across.max() + 0.05)
    axes.set_ylim(high.min() - 0.05, high.max() + 0.05)
    # Line widths are in points: how many of them a metre is here.
    points = min(
        72 * figure.get_figwidth() / (across.max() - across.min() + 0.1),
        72 * figure.get_figheight() / (high.max() - high.min() + 0.1),
    )
    for _, x, z, radius, colour in sorted(places, key=lambda place: -place[0]):
        for grown, shade in ((1.08, 0.6), (1.0, 1.0)):
            axes.plot(x, z, color=np.clip(shade * colour, 0, 1), linewidth=2 * radius * points * grown,
                      solid_capstyle="round")  # fmt: skip
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, facecolor="white")
    return buffer.getvalue()


def _camera_axes() -> Any:
    """Right, up and forward of the camera in the world."""
    azimuth, elevation = np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward
