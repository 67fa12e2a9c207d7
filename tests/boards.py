"""A printed board that somebody turns before a camera."""

from __future__ import annotations

import cv2
import numpy as np

from openant_tools.comms.intrinsics import CharucoBoard, Intrinsics

__all__ = ["TILTS", "board_views", "rotation"]


def rotation(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Body to world: about x, then y, then z."""
    x, y, z = (cv2.Rodrigues(np.array(v, float))[0] for v in ([roll, 0, 0], [0, pitch, 0], [0, 0, yaw]))
    return z @ y @ x


def board_views(lens: Intrinsics, board: CharucoBoard, tilts: list[tuple[float, float]]) -> list[np.ndarray]:
    """Pictures of a printed board, seen through a lens."""
    sheet = np.pad(board.image(80), 60, constant_values=255)
    per_m = 80 / board.square_m
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    rays = lens.rays(np.stack([u, v], -1).reshape(-1, 2))
    views = []
    for k, (roll, pitch) in enumerate(tilts):
        r = rotation(roll, pitch, 0.2 * k)
        centre = np.array([0.02 * (k % 3 - 1), 0.015 * (k % 2), 0.30 + 0.02 * (k % 4)])
        corner = centre - r @ [board.columns * board.square_m / 2, board.rows * board.square_m / 2, 0]
        back = np.linalg.inv(np.column_stack([r[:, 0], r[:, 1], corner]))
        at = np.column_stack([rays, np.ones(len(rays))]) @ back.T
        x, y = (at[:, :2] / at[:, 2:] * per_m + 59.5).T.reshape(2, lens.height, lens.width).astype(np.float32)
        views.append(cv2.GaussianBlur(cv2.remap(sheet, x, y, cv2.INTER_LINEAR, borderValue=120), (0, 0), 0.7))
    return views


TILTS = [
    (0, 0),
    (0.5, 0),
    (-0.5, 0),
    (0, 0.5),
    (0, -0.5),
    (0.4, 0.4),
    (-0.4, 0.4),
    (0.4, -0.4),
    (0.3, 0.1),
    (0.1, -0.3),
]
