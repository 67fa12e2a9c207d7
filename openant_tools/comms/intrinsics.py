"""How a camera projects: focal lengths, principal point and lens distortion, declared or measured.

Pixel coordinates are OpenCV's: (0, 0) is the centre of the top left pixel. Distortion is OpenCV's k1 k2 p1 p2 k3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number

__all__ = ["CharucoBoard", "Intrinsics", "calibrate"]

Array = NDArray[np.float64]

#: Fewer views do not separate focal length from distance; OpenCV's own guide asks for ten.
MIN_VIEWS = 8
#: corners of the board that a view must show to count
MIN_CORNERS = 12
#: Above this the board was not flat, the pictures were blurred, or its size was declared wrong.
GOOD_RMS_PX = 1.0


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with distortion.

    Attributes:
        width, height: of the pictures these numbers belong to, px.
        fx, fy, cx, cy: px.
        distortion: k1 k2 p1 p2 k3.
        source: where the numbers are from: "declared field of view", "ChArUco board", "nominal" …
        rms_px: reprojection error of the calibration, or None where there was none.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    source: str = "declared"
    rms_px: float | None = None

    @classmethod
    def from_diagonal_fov(cls, width: int, height: int, degrees: float) -> Intrinsics:
        """A lens without distortion, centred, whose diagonal field of view the box promises: f = d / (2 tan(fov/2)).

        Raises:
            BadInput: no angle of view.
        """
        if not 1.0 <= degrees <= 170.0:
            raise BadInput(
                f"a diagonal field of view of {exact(degrees, '°')}", remedy="the camera's data sheet says 55 to 90°"
            )
        f = math.hypot(width, height) / (2.0 * math.tan(math.radians(degrees) / 2.0))
        return cls(width, height, f, f, (width - 1) / 2.0, (height - 1) / 2.0, source="declared field of view")

    @property
    def matrix(self) -> Array:
        """The 3 × 3 camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Array:
        """Distortion for OpenCV, shape (5,)."""
        return np.array(self.distortion)

    def scaled(self, width: int, height: int) -> Intrinsics:
        """The same lens at another picture size of the same shape.

        Raises:
            BadInput: another shape: then the camera crops, and how is not known.
        """
        if (width, height) == (self.width, self.height):
            return self
        s = width / self.width
        if abs(height - self.height * s) > 1.0:
            raise BadInput(
                f"the camera was calibrated at {self.width}×{self.height}, its pictures are {width}×{height}",
                remedy="ask for the size it was calibrated at, or calibrate at this one",
            )
        # Pixel centres, not corners, are whole numbers: the half pixel does not scale.
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * s,
            fy=self.fy * s,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
        )

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera's frame (x right, y down, z forward, m).

        Brown's model as OpenCV writes it; `cv2.projectPoints` is the same at a fortieth of the speed.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        if any(self.distortion):
            k1, k2, p1, p2, k3 = self.distortion
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
            dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
            x, y = x * radial + dx, y * radial + dy
        return np.stack([x * self.fx + self.cx, y * self.fy + self.cy], axis=-1)

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 2) as x/z, y/z of pixels (n, 2), the distortion undone by fixed-point iteration."""
        pixels = np.asarray(pixels, float).reshape(-1, 2)
        focal = np.array([self.fx, self.fy])
        rays: Array = (pixels - [self.cx, self.cy]) / focal
        if not any(self.distortion):
            return rays
        ones = np.ones((len(rays), 1))
        for _ in range(40):
            step = (pixels - self.project(np.hstack([rays, ones]))) / focal
            rays += step
            if np.abs(step).max() < 1e-9:
                break
        return rays


@dataclass(frozen=True)
class CharucoBoard:
    """A printed ChArUco board: `columns` × `rows` squares of `square_m`, with markers of `marker_m` in them."""

    columns: int = 7
    rows: int = 5
    square_m: float = 0.035
    marker_m: float = 0.026
    dictionary: str = "DICT_5X5_100"

    def _board(self) -> Any:
        from openant_tools.optional import cv2

        table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, table)

    def image(self, pixels_per_square: int = 120) -> NDArray[np.uint8]:
        """The board to print, without margin."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(self._board().generateImage(size), np.uint8)

    def corners(self, gray: NDArray[np.uint8]) -> tuple[Array, Array] | None:
        """Board points (n, 3) in m and their pixels (n, 2), or None where too few are seen."""
        from openant_tools.optional import cv2

        board = self._board()
        found, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        points = np.asarray(board.getChessboardCorners(), float)[ids.ravel()]
        return points, np.asarray(found, float).reshape(-1, 2)


def calibrate(pictures: Sequence[NDArray[np.uint8]], board: CharucoBoard) -> Intrinsics:
    """Intrinsics from grey pictures (h, w) of a ChArUco board in several places and tilts.

    Raises:
        BadInput: too few usable views, all from one direction, or a reprojection error above a pixel; it says which.
    """
    from openant_tools.optional import cv2

    views = [view for view in (board.corners(picture) for picture in pictures) if view is not None]
    if len(views) < MIN_VIEWS:
        raise BadInput(
            f"the board is found in {len(views)} of {len(pictures)} pictures",
            remedy=f"{MIN_VIEWS} are needed: nearer, sharper, and with the whole board in view",
        )
    height, width = pictures[0].shape
    rms, matrix, distortion, rotations, _ = cv2.calibrateCamera(
        [points.astype(np.float32) for points, _ in views],
        [pixels.astype(np.float32) for _, pixels in views],
        (width, height),
        None,
        None,
    )
    normals = [cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations]
    tilt = max(math.degrees(math.acos(float(np.clip(a @ normals[0], -1, 1)))) for a in normals)
    if tilt < 15.0:
        raise BadInput(
            f"all views are within {number(tilt, '°', decimals=0)} of each other, which leaves focal length and distance mixed up",
            remedy="tilt the board by 30 to 45° in several directions",
        )
    if rms > GOOD_RMS_PX:
        raise BadInput(
            f"the calibration fits to {number(rms, 'px', decimals=1)} only",
            remedy="glue the board to something flat, keep it still, and measure its squares",
        )
    k = [float(v) for v in np.ravel(distortion)[:5]]
    return Intrinsics(
        width=width,
        height=height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        distortion=(k[0], k[1], k[2], k[3], k[4]),
        source="ChArUco board",
        rms_px=float(rms),
    )
