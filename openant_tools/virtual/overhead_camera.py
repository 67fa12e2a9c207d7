"""The overhead webcam's picture of the arena, computed on the processor alone.

A floor with an origin tag, and a robot with a body tag, seen by a lens with perspective and distortion; then blur,
motion blur, mains flicker, vignetting, shot noise. The tags are the detector library's own bitmaps. `picture` is a
function of the settings, the seed, the frame's number and the scene alone, so a frame can be rendered late, or never.

The ray of each pixel, its distortion undone, meets a plane (floor or tag), whose texture is sampled; tags at 3 × 3
points a pixel. The floor never moves and is rendered once; per frame only the robot's surroundings are painted.

Frames: world z up, floor at z = 0; body x forward, y left, z up; camera x right, y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.intrinsics import Intrinsics
from openant_tools.comms.tag_family import load_family
from openant_tools.optional import cv2
from openant_tools.virtual.camera_scene import OverheadCameraSettings, Scene

__all__ = ["OverheadCamera"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Samples a pixel in each direction.
SUPERSAMPLE = 3
#: Instants of an exposure that are drawn at most.
MAX_MOMENTS = 7
#: Floor texture: a square around the arena, mirrored at its edges.
FLOOR_SIDE_M = 4.5
FLOOR_TEXEL_M = 0.002
#: Texels a cell of a tag, and paper around it.
CELL_TEXELS = 24
PAPER_CELLS = 1
#: of the room's light, which flickers at twice that
MAINS_HZ = 50.0


@dataclass(frozen=True)
class _Parts:
    """What is to be painted of one scene: (distance, outline, colour) farthest first; shadows; the tag's place."""

    outlines: list[tuple[float, Array, tuple[float, float, float]]]
    shadows: list[Array]
    tag: tuple[Array, Array] | None
    corners: Array


@dataclass(frozen=True)
class _Board:
    """A tag on its paper: texture (n, n) with its side in m and its pose in whatever carries it."""

    texture: Image
    side: float


class OverheadCamera:
    """The lens, the room and the sensor. Not the cable: `openant_tools.virtual.camera_stream` carries the pictures."""

    def __init__(self, settings: OverheadCameraSettings, seed: int) -> None:
        self.settings = settings
        self.intrinsics = settings.intrinsics
        self._seed = seed
        self._world_from_camera = _look(settings.position, settings.look_at, settings.up_yaw)
        self._eye = np.asarray(settings.position, float)
        self._rays = _ray_map(self.intrinsics)
        self._vignette = self._vignetting()
        rng = np.random.default_rng([seed, 0x5EED])
        self._sharp_floor = self._render_floor()
        self._floor = self._blurred(self._sharp_floor, (0, 0, settings.width, settings.height))
        self._noise = self._noise_bank(rng)
        self._body_tag = (
            None if settings.body is None else _board(settings.body.family, settings.body.id, settings.body.size)
        )

    # --- what the world looks like ---------------------------------------------------------------------------------

    def picture(self, index: int, t: float, scene: Scene) -> Image:
        """Frame number `index`, exposed around `t` while the scene was `scene`: (height, width, 3), blue green red."""
        image = self._floor.copy()
        parts = [self._parts(moment) for moment in self._moments(scene)]
        corners = [part.corners for part in parts if len(part.corners)]
        if corners:
            margin = 6 + math.ceil(4 * self.settings.blur_px)
            points = np.concatenate(corners)
            low = np.floor(points.min(0)).astype(int) - margin
            high = np.ceil(points.max(0)).astype(int) + margin + 1
            x0, y0 = np.maximum(low, 0)
            x1, y1 = np.minimum(high, [self.settings.width, self.settings.height])
            if x1 - x0 > 1 and y1 - y0 > 1:
                box = (int(x0), int(y0), int(x1), int(y1))
                image[y0:y1, x0:x1] = self._blurred(self._drawn(parts, box), box)
        return self._expose(image, index, t)

    def _moments(self, scene: Scene) -> list[Scene]:
        """The scene at evenly spaced instants of the exposure, more of them the faster it moves."""
        speed = float(np.linalg.norm(scene.velocity)) + float(np.linalg.norm(scene.rate)) * scene.torso_radius
        distance = abs(self._eye[2] - scene.position[2])
        smear_px = speed * self.settings.exposure_s * self.intrinsics.fx / max(distance, 0.1)
        count = min(1 + 2 * round(smear_px / 2), MAX_MOMENTS)
        if count == 1:
            return [scene]
        exposure = self.settings.exposure_s
        return [scene.moved(exposure * ((k + 0.5) / count - 0.5)) for k in range(count)]

    def _drawn(self, parts: Sequence[_Parts], box: tuple[int, int, int, int]) -> Image:
        """The sharp picture within a box, averaged over the instants of the exposure."""
        x0, y0, x1, y1 = box
        shots = []
        for part in parts:
            patch = self._sharp_floor[y0:y1, x0:x1].copy()
            self._draw(part, patch, x0, y0)
            shots.append(patch)
        if len(shots) == 1:
            return shots[0]
        return np.asarray(np.mean(shots, axis=0, dtype=np.float32), np.uint8)

    def _blurred(self, patch: Image, box: tuple[int, int, int, int]) -> Image:
        """Vignetting and the lens' blur, as the floor had them."""
        x0, y0, x1, y1 = box
        lit = cv2.multiply(patch, self._vignette[y0:y1, x0:x1], dtype=cv2.CV_8U)
        return np.asarray(cv2.GaussianBlur(lit, (0, 0), self.settings.blur_px) if self.settings.blur_px > 0 else lit)

    def _expose(self, image: Image, index: int, t: float) -> Image:
        """Flicker and noise."""
        s = self.settings
        rng = np.random.default_rng([self._seed, index])
        phase = 2 * math.pi * 2 * MAINS_HZ
        # The mean of 1 + flicker·sin over the exposure: long exposures average it away.
        gain = 1.0 + s.flicker * np.sinc(2 * MAINS_HZ * s.exposure_s) * math.sin(phase * t)
        if abs(gain - 1.0) > 1e-4:
            image = cv2.convertScaleAbs(image, alpha=gain)
        if s.noise > 0:
            dy, dx = rng.integers(0, _NOISE_MARGIN, 2)
            noise = self._noise[dy : dy + s.height, dx : dx + s.width]
            image = cv2.add(image, noise, dtype=cv2.CV_8U)
        return np.asarray(image)

    def _parts(self, scene: Scene) -> _Parts:
        """Outlines of shadow and robot in pixels, farthest first, and the body tag's place."""
        if not scene.there:
            return _Parts([], [], None, np.empty((0, 2)))
        centre = np.asarray(scene.position, float)
        tag = self._tag_plane(centre, np.asarray(scene.rotation, float))
        outlines: list[tuple[float, Array, tuple[float, float, float]]] = []
        shadows: list[Array] = []
        if not self.settings.bare:
            for limb in np.asarray(scene.limbs, float).reshape(-1, 7):
                a, b, radius = limb[:3], limb[3:6], float(limb[6])
                outlines.append((self._distance((a + b) / 2), self._capsule(a, b, radius), _LIMB))
                shadows.append(self._capsule(_shadow(a), _shadow(b), radius))
            torso = self._capsule(centre, centre, scene.torso_radius)
            outlines.append((self._distance(_above(centre, scene.torso_radius)), torso, _TORSO))
            shadows.append(self._capsule(_shadow(centre), _shadow(centre), scene.torso_radius))
        outlines.sort(key=lambda item: -item[0])
        places = [outline for _, outline, _ in outlines] + shadows
        if tag is not None:
            places.append(self._pixels(tag[1]))
        return _Parts(outlines, shadows, tag, np.concatenate(places) if places else np.empty((0, 2)))

    def _distance(self, point: Array) -> float:
        return float(np.linalg.norm(point - self._eye))

    def _draw(self, part: _Parts, patch: Image, x0: int, y0: int) -> None:
        """Paint shadow, limbs, torso and tag over the sharp floor of a box whose corner pixel is (x0, y0)."""
        light = self.settings.brightness / 255.0
        if part.shadows:
            dark = np.full(patch.shape[:2], 255, np.uint8)
            for outline in part.shadows:
                cv2.fillConvexPoly(dark, _fixed(outline, x0, y0), 255 * (1 - _SHADOW), cv2.LINE_AA, _SHIFT)
            # The edge of a shadow is soft: lamps have a size.
            dark = cv2.blur(dark, (7, 7))
            patch[:] = cv2.multiply(patch, cv2.cvtColor(dark, cv2.COLOR_GRAY2BGR), scale=1 / 255)
        tag_distance = math.inf if part.tag is None else self._distance(part.tag[0][:, 3])
        drawn = False
        for distance, outline, shade in part.outlines:
            if not drawn and distance < tag_distance - 0.03:
                self._draw_tag(part.tag, patch, x0, y0)
                drawn = True
            colour = tuple(v * light for v in shade)
            cv2.fillConvexPoly(patch, _fixed(outline, x0, y0), colour, cv2.LINE_AA, _SHIFT)
            # A lit ridge: plastic is not flat.
            middle = outline.mean(0)
            ridge = _fixed(middle + (outline - middle) * 0.55, x0, y0)
            bright = tuple(min(255.0, v * 1.18 + 8) * light for v in shade)
            cv2.fillConvexPoly(patch, ridge, bright, cv2.LINE_AA, _SHIFT)
        if not drawn:
            self._draw_tag(part.tag, patch, x0, y0)

    def _tag_plane(self, centre: Array, rotation: Array) -> tuple[Array, Array] | None:
        """World from tag, 3 × 4, and the paper's corners in the world; None where it faces away or there is none."""
        body = self.settings.body
        if body is None or self._body_tag is None:
            return None
        c, n = math.cos(body.yaw), math.sin(body.yaw)
        turn = np.array([[c, -n, 0], [n, c, 0], [0, 0, 1.0]])
        pose = np.column_stack([rotation @ turn, centre + rotation @ np.asarray(body.position)])
        if (self._eye - pose[:, 3]) @ pose[:, 2] <= 0:
            return None
        return pose, _square(pose, self._body_tag.side)

    def _draw_tag(self, tag: tuple[Array, Array] | None, patch: Image, x0: int, y0: int) -> None:
        if tag is not None and self._body_tag is not None:
            self._draw_board(self._body_tag, tag, patch, x0, y0)

    def _draw_board(self, board: _Board, place: tuple[Array, Array], patch: Image, x0: int, y0: int) -> None:
        """Paint a tag's paper: its pose (3 × 4, world) and corners (4, 3), into a box with corner pixel (x0, y0)."""
        pose, corners = place
        pixels = self._pixels(corners)
        low = np.maximum(np.floor(pixels.min(0)).astype(int) - 1, [x0, y0])
        high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 2, [x0 + patch.shape[1], y0 + patch.shape[0]])
        if np.any(high - low < 1):
            return
        grey, cover = _sample(board, self._camera_from(pose), self._fine_rays(low[0], low[1], high[0], high[1]))
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        alpha = cover.astype(np.float32)
        shade = alpha * grey * np.float32(self.settings.brightness / 255.0)
        alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)[:, :, None]
        shade = cv2.resize(shade, size, interpolation=cv2.INTER_AREA)[:, :, None]
        part = np.s_[low[1] - y0 : high[1] - y0, low[0] - x0 : high[0] - x0]
        patch[part] = patch[part] * (1 - alpha) + shade + 0.5

    # --- the lens ---------------------------------------------------------------------------------------------------

    def _fine_rays(self, x0: int, y0: int, x1: int, y1: int) -> NDArray[np.float32]:
        """Rays of the n × n samples of each pixel of a box: (n·(y1−y0), n·(x1−x0), 2)."""
        n = SUPERSAMPLE
        # Between neighbouring pixels the undistorted ray is as good as linear; the margin is cut off again.
        coarse = self._rays[y0 : y1 + 2, x0 : x1 + 2]
        size = (coarse.shape[1] * n, coarse.shape[0] * n)
        return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)[n:-n, n:-n], np.float32)

    def _camera_from(self, pose: Array) -> Array:
        """Camera from plane, 3 × 3: columns are the plane's two axes and its origin."""
        r = self._world_from_camera.T
        return np.column_stack([r @ pose[:, 0], r @ pose[:, 1], r @ (pose[:, 3] - self._eye)])

    def _pixels(self, points: Array) -> Array:
        """Pixels (n, 2) of world points (n, 3)."""
        return self.intrinsics.project((np.asarray(points, float) - self._eye) @ self._world_from_camera)

    def _capsule(self, a: Array, b: Array, radius: float) -> Array:
        """Convex outline (n, 2) of a capsule in the world, in pixels."""
        ends = (np.stack([a, b]) - self._eye) @ self._world_from_camera
        angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1) * radius
        outline = self.intrinsics.project(np.concatenate([ends[0] + ring, ends[1] + ring]))
        return np.asarray(cv2.convexHull(outline.astype(np.float32)), float).reshape(-1, 2)

    def _vignetting(self) -> NDArray[np.float32]:
        s = self.settings
        y, x = np.mgrid[0 : s.height, 0 : s.width].astype(np.float32)
        r2 = ((x - s.width / 2) ** 2 + (y - s.height / 2) ** 2) / (s.width**2 + s.height**2) * 4
        return np.asarray(np.repeat((1.0 - s.vignette * r2)[:, :, None], 3, axis=2), np.float32)

    # --- what never changes -----------------------------------------------------------------------------------------

    def _render_floor(self) -> Image:
        """The floor with its tag, sharp and evenly lit."""
        s = self.settings
        texture = _floor_texture(self._seed)
        plane = np.hstack([np.eye(3), np.array([[s.look_at[0]], [s.look_at[1]], [0.0]])])
        at = _plane_coordinates(self._camera_from(plane), self._rays[1:-1, 1:-1])
        u = at[:, :, 0] / FLOOR_TEXEL_M + texture.shape[1] / 2 - 0.5
        v = -at[:, :, 1] / FLOOR_TEXEL_M + texture.shape[0] / 2 - 0.5
        floor = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        floor = cv2.convertScaleAbs(floor, alpha=s.brightness / 255.0)
        if s.origin is not None:
            c, n = math.cos(s.origin.yaw), math.sin(s.origin.yaw)
            pose = np.array([[c, -n, 0, s.origin.x], [n, c, 0, s.origin.y], [0, 0, 1.0, 0]])
            board = _board(s.origin.family, s.origin.id, s.origin.size)
            self._draw_board(board, (pose, _square(pose, board.side)), floor, 0, 0)
        return np.asarray(floor)

    def _noise_bank(self, rng: np.random.Generator) -> NDArray[np.int8]:
        s = self.settings
        shape = (s.height + _NOISE_MARGIN, s.width + _NOISE_MARGIN)
        grey = rng.standard_normal(shape, np.float32) * s.noise
        # Webcams sample colour at a quarter of the pixels: their noise is mostly grey, with coarse colour blotches.
        coarse = rng.standard_normal((shape[0] // 4 + 1, shape[1] // 4 + 1, 3), np.float32) * (0.6 * s.noise)
        colour = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.clip(np.rint(grey[:, :, None] + colour), -127, 127), np.int8)


_NOISE_MARGIN = 64
_SHIFT = 4
_SHADOW = 0.35
_LIMB = (52.0, 48.0, 46.0)
_TORSO = (168.0, 164.0, 158.0)
#: Where the ceiling lamp's light comes from: a shadow falls this far for each metre of height.
_LIGHT = np.array([0.22, -0.15])


def _above(point: Array, height: float) -> Array:
    return np.array([point[0], point[1], point[2] + height])


def _shadow(point: Array) -> Array:
    return np.array([point[0] + _LIGHT[0] * point[2], point[1] + _LIGHT[1] * point[2], 0.0])


def _fixed(outline: Array, x0: int, y0: int) -> NDArray[np.int32]:
    """Fixed-point coordinates of an outline in a box whose corner pixel is (x0, y0)."""
    return np.rint((outline - [x0, y0]) * (1 << _SHIFT)).astype(np.int32)


@lru_cache(maxsize=4)
def _ray_map(lens: Intrinsics) -> NDArray[np.float32]:
    """x/z and y/z of every pixel's centre: (height + 2, width + 2, 2), with one pixel of margin."""
    u, v = np.meshgrid(np.arange(-1.0, lens.width + 1), np.arange(-1.0, lens.height + 1))
    rays = lens.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    return rays.reshape(lens.height + 2, lens.width + 2, 2).astype(np.float32)


def _look(position: Sequence[float], target: Sequence[float], up_yaw: float) -> Array:
    """World from camera, 3 × 3, for a camera that looks at `target` with the direction `up_yaw` up in the picture."""
    forward = np.asarray(target, float) - np.asarray(position, float)
    forward /= np.linalg.norm(forward)
    up = np.array([math.cos(up_yaw), math.sin(up_yaw), 0.0])
    down = -(up - forward * (up @ forward))
    down /= np.linalg.norm(down)
    return np.column_stack([np.cross(down, forward), down, forward])


def _board(family: str, tag_id: int, size: float) -> _Board:
    kind = load_family(family)
    cells = np.pad(kind.bitmap(tag_id), PAPER_CELLS, constant_values=255)
    # Ink is not quite black, and paper is white: contrast as a webcam sees it.
    cells = np.where(cells > 0, 255, 28).astype(np.uint8)
    texture = np.kron(cells, np.ones((CELL_TEXELS, CELL_TEXELS), np.uint8))
    return _Board(texture, size * cells.shape[0] / kind.edge_cells)


def _square(pose: Array, side: float) -> Array:
    """Corners (4, 3) of a square of `side` around a pose (3 × 4, in its own x and y)."""
    h = side / 2
    return np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]]) @ pose[:, :3].T + pose[:, 3]


def _plane_coordinates(camera_from_plane: Array, rays: NDArray[np.float32]) -> NDArray[np.float32]:
    """Where rays meet a plane, in its own two axes, m."""
    back = np.linalg.inv(camera_from_plane)
    homogeneous = cv2.transform(rays, back.astype(np.float32))  # rows of 3 over (x, y) and an implied 1
    return np.asarray(homogeneous[:, :, :2] / homogeneous[:, :, 2:], np.float32)


def _sample(board: _Board, camera_from_tag: Array, rays: NDArray[np.float32]) -> tuple[Image, NDArray[np.bool_]]:
    """Grey level of a tag's paper along rays, and where they meet it. The tag's x is its up, y its left."""
    at = _plane_coordinates(camera_from_tag, rays)
    texels = board.texture.shape[0]
    per_m = texels / board.side
    u = -at[:, :, 1] * per_m + texels / 2 - 0.5
    v = -at[:, :, 0] * per_m + texels / 2 - 0.5
    cover = (u > -0.5) & (u < texels - 0.5) & (v > -0.5) & (v < texels - 0.5)
    grey = cv2.remap(board.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, np.uint8), cover


@lru_cache(maxsize=2)
def _floor_texture(seed: int) -> Image:
    """A laminate floor: planks with grain, joints, stains; a strip of tape. (n, n, 3), blue green red."""
    rng = np.random.default_rng([seed, 0xF100])
    n = round(FLOOR_SIDE_M / FLOOR_TEXEL_M)
    plank, length = round(0.19 / FLOOR_TEXEL_M), round(1.3 / FLOOR_TEXEL_M)
    base = np.empty((n, n), np.float32)
    for y in range(0, n, plank):
        offset = int(rng.integers(length))
        for x in range(-offset, n, length):
            left = max(0, x)
            base[y : y + plank, left : x + length] = 138 + 12 * rng.standard_normal()
            base[y : y + plank, max(0, x + length - 2) : x + length] = 92
        base[max(0, y - 1) : y + 1] = 98
    # Grain runs along the planks; stains have no direction.
    grain = cv2.resize(
        rng.standard_normal((n // 2, n // 40)).astype(np.float32), (n, n), interpolation=cv2.INTER_LINEAR
    )
    blotches = cv2.resize(rng.standard_normal((24, 24)).astype(np.float32), (n, n), interpolation=cv2.INTER_CUBIC)
    base += 7 * grain + 5 * blotches
    warm = np.array([0.80, 0.93, 1.05], np.float32)
    floor = np.clip(base[:, :, None] * warm, 0, 255).astype(np.uint8)
    tape = round(0.05 / FLOOR_TEXEL_M)
    a = round((FLOOR_SIDE_M / 2 - 1.25) / FLOOR_TEXEL_M)
    cv2.rectangle(floor, (a, a), (n - a, n - a), (60, 150, 205), tape)
    return np.ascontiguousarray(floor)
