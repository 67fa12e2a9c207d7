"""Sensors that mislead: gyros of another step, hands that stop early, pictures that can be read in two ways, figures that are none."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from campaign import Campaign
from numpy.typing import NDArray

from openant_tools.calib.gyro_scale import KNOWN, by_hand
from openant_tools.comms.tag_family import load_family
from openant_tools.comms.tags import BodyPose, BodyTracker, TagSetup
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.virtual.camera_scene import OverheadCameraSettings, Scene, TagOnFloor
from openant_tools.virtual.overhead_camera import OverheadCamera

__all__ = ["campaigns"]

Picture = NDArray[np.uint8]

SETTINGS = OverheadCameraSettings(
    width=640, height=360, position=(0.0, 0.0, 1.0), fps=30.0, origin=TagOnFloor(x=0.0, y=0.0)
)
#: m; a pose that is farther off is a wrong one.
WRONG_M = 0.02


def _scene(rng: np.random.Generator) -> Scene:
    """A robot beside the origin's tag, turned anyhow."""
    yaw, place = rng.uniform(-math.pi, math.pi), np.array([0.25, rng.uniform(-0.14, 0.14), 0.15])
    return Scene(place, cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0])


def _settled(camera: OverheadCamera, scene: Scene) -> BodyTracker:
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    for n in range(8):
        tracker.track(camera.picture(n, n / 30, scene), n / 30)
    return tracker


def _no_wrong_pose(tracker: BodyTracker, pictures: list[Picture], truth: NDArray[np.float64]) -> bool:
    found = [tracker.track(picture, 1.0 + n / 30) for n, picture in enumerate(pictures)]
    return all(float(np.linalg.norm(p.position - truth)) < WRONG_M for p in found if isinstance(p, BodyPose))


def _zoom(k: int) -> bool:
    rng = np.random.default_rng(k)
    camera, scene = OverheadCamera(SETTINGS, seed=k), _scene(rng)
    tracker, share = _settled(camera, scene), rng.uniform(0.8, 0.92)
    dy, dx = round(180 * (1 - share)), round(320 * (1 - share))
    crop = [camera.picture(20 + n, 1.0, scene)[dy : 360 - dy, dx : 640 - dx] for n in range(14)]
    return _no_wrong_pose(tracker, [np.asarray(cv2.resize(p, (640, 360)), np.uint8) for p in crop], scene.position)


def _stretched(k: int) -> bool:
    rng = np.random.default_rng(k)
    camera, scene = OverheadCamera(SETTINGS, seed=k), _scene(rng)
    tracker, cut = _settled(camera, scene), int(rng.integers(20, 40))
    pictures = [camera.picture(20 + n, 1.0, scene)[:, cut : 640 - cut] for n in range(14)]
    return _no_wrong_pose(tracker, [np.asarray(cv2.resize(p, (640, 360)), np.uint8) for p in pictures], scene.position)


def _moved(k: int) -> bool:
    rng = np.random.default_rng(k)
    camera, scene = OverheadCamera(SETTINGS, seed=k), _scene(rng)
    tracker = _settled(camera, scene)
    to = (float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.06)), float(rng.uniform(-0.03, 0.03)), 0.0)
    pictures = [OverheadCamera(replace(SETTINGS, look_at=to), seed=k).picture(20 + n, 1.0, scene) for n in range(4)]
    for picture in pictures:
        picture[130:230, 270:370] = 90  # somebody's hand lies on the origin's tag, and stays there
    return _no_wrong_pose(tracker, pictures, scene.position)


def _two_sheets(k: int) -> bool:
    rng = np.random.default_rng(k)
    camera, scene = OverheadCamera(SETTINGS, seed=k), _scene(rng)
    tracker, cell = _settled(camera, scene), int(rng.integers(5, 9))
    bitmap = np.pad(load_family("tagCircle21h7").bitmap(12), 1, constant_values=255)
    sheet = np.kron(bitmap, np.ones((cell, cell), np.uint8))
    pictures = []
    for n in range(8):
        # The robot and the sheet, then the sheet alone, by turns.
        here = scene if n % 2 == 0 else Scene(np.array([9.0, 0.0, 0.15]), scene.rotation)
        picture = camera.picture(20 + n, 1.0, here)
        picture[10 : 10 + len(sheet), 10 : 10 + len(sheet)] = sheet[:, :, None]
        pictures.append(picture)
    return _no_wrong_pose(tracker, pictures, scene.position)


def _early_hand(k: int) -> bool:
    rng = np.random.default_rng(k)
    step, now = (KNOWN[str(name)] for name in rng.choice(list(KNOWN), 2))
    turns = [(n * math.pi / 2 + math.radians(rng.normal(0.0, 4.0))) * step / now for n in (1, 2)]
    found = by_hand(turns, now)
    return found is None or math.isclose(found.counts_per_dps, step)


def _no_figure(k: int) -> bool:
    rng = np.random.default_rng(k)
    figures = [float(rng.choice([1.0, 0.5, math.nan, math.inf, -math.inf])) for _ in range(4)]
    unknown = not all(map(math.isfinite, figures))
    evidence = tuple(Evidence(f"figure {n}", value, "1", "campaign") for n, value in enumerate(figures))
    finding = Finding("campaign", True, "all is well", evidence, "", "benchmarks/reliability.py")
    return (finding.ok is None and bool(finding.unsure)) if unknown else finding.ok is True


def campaigns() -> list[Campaign]:
    """The rows of this part."""
    return [
        Campaign("the camera zooms or crops in the old picture size: no pose off by 2 cm", 5, _zoom),
        Campaign("the picture is stretched from another shape: no pose off by 2 cm", 5, _stretched),
        Campaign("the camera is pushed while the origin's tag is hidden: no pose off by 2 cm", 5, _moved),
        Campaign("a second sheet wears the robot's number: no pose off by 2 cm", 5, _two_sheets),
        Campaign(
            "hands that turn by 90° and 180° ± 4° (one deviation): no gyro taken for one of another step",
            2000,
            _early_hand,
        ),
        Campaign("figures of a finding are NaN or infinite: it never says yes", 2000, _no_figure),
    ]
