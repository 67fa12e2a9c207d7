"""Pictures of a simulated robot, drawn off screen and only when asked for."""

from __future__ import annotations

import atexit
import importlib
import io
import itertools
import os
import platform
import shutil
import subprocess
import threading
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import write_bytes
from openant_tools.numbers import column
from openant_tools.opengl import CHOSEN_GL

__all__ = ["VIDEO_BYTES", "NoOpenGL", "Painter", "write_mp4", "write_strip", "write_video"]

Image = NDArray[np.uint8]
ARROW_RGBA = (0.0, 0.447, 0.698, 1.0)  # Okabe–Ito blue
CIRCLE_RGBA = (0.337, 0.706, 0.914, 1.0)  # Okabe–Ito sky blue
CIRCLE_SEGMENTS = 48
#: pictures side by side in a strip
STRIP_COLUMNS = 4
#: s that a closed window may take to end its last picture
CLOSING_S = 5.0
#: bytes that a video may have: it goes into reports
VIDEO_BYTES = 3_000_000
#: of WebP, from 0 to 100, in the order in which they are tried until a video is small enough
VIDEO_QUALITIES = (70, 45, 20, 0)


class NoOpenGL(BadInput):
    """This machine has no OpenGL to draw with."""


def _backends() -> list[str]:
    """MuJoCo's OpenGL backends, the likeliest to work first; one that is named, be it none, is the only one."""
    chosen = os.environ.get(CHOSEN_GL, os.environ.get("MUJOCO_GL", "")).strip().lower()
    if chosen in ("disable", "disabled", "off", "false", "0"):
        return []
    if chosen not in ("", "enable", "enabled", "on", "true", "1", "glx", "wgl"):
        return [chosen]
    if platform.system() == "Darwin":
        return ["cgl", "glfw"]
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return ["glfw", "egl"] if has_display else ["egl", "osmesa"]


def _gl_context(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """OpenGL's context, current from now on, and MuJoCo's in it."""
    # MuJoCo's own Renderer takes its backend from the environment as it was when mujoco was first imported, and
    # fails on a machine without display unless that was set; here the choice is made when a picture is wanted.
    reasons = []
    for backend in _backends():
        try:
            with warnings.catch_warnings():  # the reason stands in the error
                warnings.simplefilter("ignore")
                context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
                context.make_current()
                # GLFW makes none where there is no display, and says nothing of it: MuJoCo does.
                return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, GLError, …
            reasons.append(f"{backend}: {error or type(error).__name__}".splitlines()[0])
    raise NoOpenGL(
        f"no picture of the robot can be drawn, there is no OpenGL here ({'; '.join(reasons) or 'MUJOCO_GL says so'})",
        remedy="pip install 'openant-tools[view]' and an EGL or OSMesa library, or go on without pictures",
    )


class Painter:
    """Draws a model's state from a camera that follows the robot.

    Args:
        model: the compiled model; its off-screen buffer is enlarged where needed.
        width, height: pixels.

    Raises:
        NoOpenGL: there is nothing to draw with.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 480, height: int = 360) -> None:
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._gl, self._context = _gl_context(model, width, height)
        self._model = model
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, 1000)
        self._option = mujoco.MjvOption()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def frame(
        self,
        data: mujoco.MjData,
        *,
        look_at: tuple[float, float, float],
        camera_at: tuple[float, float, float] | None = None,
        arrow: tuple[float, float] | None = None,
        circle: tuple[float, float, float] | None = None,
        azimuth_deg: float = 90.0,
        elevation_deg: float = -35.0,
        distance_m: float = 1.1,
    ) -> Image:
        """One picture, (height, width, 3).

        Args:
            data: the state; its positions must be up to date (`mj_kinematics`).
            look_at: m, where the robot is.
            camera_at: m, the point in the middle of the picture; None: where the robot is.
            arrow: a unit vector in the plane, drawn above the robot.
            circle: x, y and radius in m, drawn on the floor.
            azimuth_deg, elevation_deg, distance_m: where the camera stands.
        """
        self._gl.make_current()
        camera = mujoco.MjvCamera()
        camera.lookat[:] = look_at if camera_at is None else camera_at
        camera.azimuth, camera.elevation, camera.distance = azimuth_deg, elevation_deg, distance_m
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        if circle is not None:
            x, y, radius = circle
            angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_SEGMENTS + 1)
            points = np.column_stack(
                [x + radius * np.cos(angles), y + radius * np.sin(angles), np.full_like(angles, 2e-3)]
            )
            for a, b in itertools.pairwise(points):
                self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, 0.004, a, b, CIRCLE_RGBA)
        if arrow is not None:
            start = np.array([look_at[0], look_at[1], look_at[2] + 0.12])
            end = start + 0.25 * np.array([arrow[0], arrow[1], 0.0])
            self._connect(mujoco.mjtGeom.mjGEOM_ARROW, 0.012, start, end, ARROW_RGBA)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return pixels[::-1].copy()

    def _connect(
        self, kind: mujoco.mjtGeom, width: float, start: NDArray[Any], end: NDArray[Any], rgba: tuple[float, ...]
    ) -> None:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, np.float32))
        mujoco.mjv_connector(geom, kind, width, np.asarray(start, float), np.asarray(end, float))
        scene.ngeom += 1

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._context.free()
        self._gl.free()


class Window:
    """MuJoCo's own viewer on a simulation that somebody else steps; closing it does not stop that.

    Args:
        model, data: what is shown.
        dt: s, the time between two pictures.

    Raises:
        NoOpenGL: there is no screen, or what opens windows is not installed.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, dt: float) -> None:
        instead = "use render_mode='rgb_array', or run it under `xvfb-run`"
        if platform.system() == "Linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise NoOpenGL("there is no screen here to open a window on", remedy=instead)
        try:
            viewer = importlib.import_module("mujoco.viewer")
            before = set(threading.enumerate())
            self._viewer: Any = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except ImportError as error:
            raise NoOpenGL(
                f"no window can be opened: {error}", remedy="pip install 'openant-tools[view]', or " + instead
            ) from error
        except RuntimeError as error:  # macOS wants its own launcher
            raise NoOpenGL(f"no window can be opened: {error}", remedy=instead) from error
        # Its thread draws on after it was told to end: a process that ends meanwhile hangs or crashes in the graphics driver.
        self._threads = [thread for thread in threading.enumerate() if thread not in before]
        atexit.register(self.close)
        self._dt = dt
        self._next = time.monotonic()

    def show(self) -> None:
        """Draw the state as it is, no sooner than `dt` after the last one."""
        if not self._viewer.is_running():
            return
        self._viewer.sync()
        now = time.monotonic()
        self._next = max(self._next + self._dt, now)
        time.sleep(self._next - now)

    def close(self) -> None:
        """Close the window, and wait until nothing is drawn any more."""
        atexit.unregister(self.close)
        self._viewer.close()
        for thread in self._threads:
            thread.join(CLOSING_S)


def write_strip(pictures: Sequence[Image], file: Path, *, seconds_apart: float) -> None:
    """Write pictures side by side, each with its time, as one PNG.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    columns = min(STRIP_COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    height, width, _ = pictures[0].shape
    close_together = ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0.0, hspace=0.0)
    figure = Figure(figsize=(2.4 * columns, 2.4 * rows * height / width), layout=close_together)
    times = column([k * seconds_apart for k in range(len(pictures))], "s")
    for k, axes in enumerate(figure.subplots(rows, columns, squeeze=False).flat):
        axes.axis("off")
        if k < len(pictures):
            axes.imshow(pictures[k])
            axes.text(0.03, 0.95, times[k], transform=axes.transAxes, va="top", fontsize=9, color="0.15")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=160)
    write_bytes(file, picture.getvalue())


def write_video(pictures: Sequence[Image], file: Path, *, seconds_apart: float) -> None:
    """Write pictures as an animated WebP of at most `VIDEO_BYTES` that plays in real time, for ever.

    Raises:
        OSError: the file cannot be written.
    """
    from PIL import Image as Pillow

    whole = [Pillow.fromarray(picture) for picture in pictures]
    for coarser in range(len(VIDEO_QUALITIES) + 4):
        # Where the coarsest quality does not do, every second picture, every fourth, … does.
        skip = 2 ** max(0, coarser - len(VIDEO_QUALITIES) + 1)
        first, *others = whole[::skip]
        film = io.BytesIO()
        first.save(
            film, format="WEBP", save_all=True, append_images=others, duration=round(1e3 * seconds_apart * skip), loop=0,
            quality=VIDEO_QUALITIES[min(coarser, len(VIDEO_QUALITIES) - 1)], method=1,
        )  # fmt: skip
        if film.tell() <= VIDEO_BYTES:
            break
    write_bytes(file, film.getvalue())


def write_mp4(pictures: Sequence[Image], file: Path, *, seconds_apart: float) -> bool:
    """Write pictures as an MP4 by ffmpeg; False where there is none, or one that cannot."""
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        return False
    height, width, _ = pictures[0].shape
    file.parent.mkdir(parents=True, exist_ok=True)
    made = file.with_name(f".{file.name}")
    command = [
        ffmpeg, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", f"{1 / seconds_apart:.6f}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(made),  # for a file
    ]  # fmt: skip
    try:
        done = subprocess.run(command, input=b"".join(map(bytes, pictures)), capture_output=True, check=False)
    except OSError:
        return False
    if done.returncode == 0:
        made.replace(file)
    made.unlink(missing_ok=True)
    return done.returncode == 0
