"""How well the body is found: each tag family at five distances and five tilts in the rendered arena.

The camera is a 1280 × 720 webcam of 60° diagonal with distortion, noise, flicker and JPEG, the tags have upstream's
sizes (origin 0.10 m, body 0.045 m). The lens is known. `imu` passes roll and pitch, wrong by 1° at random, to the
tracker.

    python benchmarks/tag_pose.py [--pictures 4] [--family tagCircle21h7] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import cv2
import numpy as np

from openant_tools.comms.tags import BodyPose, BodyTracker, TagSetup
from openant_tools.virtual.camera_scene import OverheadCameraSettings, Scene, TagOnFloor, TagOnRobot
from openant_tools.virtual.overhead_camera import OverheadCamera

FAMILIES = ("tagCircle21h7", "tag36h11", "tag25h9", "tag16h5")
DISTANCES = (1.0, 1.5, 2.0, 2.5, 3.0)
TILTS_DEG = (0, 10, 20, 30, 40)
BODY_HEIGHT = 0.15
TAG_ABOVE_BODY = 0.085
IMU_ERROR_RAD = math.radians(1.0)


def turn(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """World from body: about x, then y, then z."""
    axes = np.diag([roll, pitch, yaw])
    x, y, z = (np.asarray(cv2.Rodrigues(axis)[0]) for axis in axes)
    return np.asarray(z @ y @ x)


def measure(family: str, distance: float, pictures: int, rng: np.random.Generator) -> list[dict[str, float | bool]]:
    """One camera height, all tilts, with and without the IMU."""
    height = distance + BODY_HEIGHT + TAG_ABOVE_BODY
    settings = OverheadCameraSettings(
        position=(0.1 * height, -0.15 * height, height),
        origin=TagOnFloor(family, x=0.0, y=0.0),
        body=TagOnRobot(family, 12),
    )
    camera = OverheadCamera(settings, seed=int(rng.integers(2**31)))
    tracker = BodyTracker(TagSetup(family), camera.intrinsics)
    count = 0

    def photo(scene: Scene) -> np.ndarray:
        nonlocal count
        count += 1
        image = camera.picture(count, count / settings.fps, scene)
        return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1], 1))

    for _ in range(20):
        tracker.track(photo(Scene(np.array([99.0, 0, 0]), np.eye(3))), 0.0)
    rows: list[dict[str, float | bool]] = []
    for tilt in TILTS_DEG:
        for _ in range(pictures):
            towards, yaw = rng.uniform(-math.pi, math.pi, 2)
            roll, pitch = math.radians(tilt) * math.cos(towards), math.radians(tilt) * math.sin(towards)
            # Within the picture, which is 1.0 × 0.57 of the distance, and not on the origin tag.
            place = np.array([rng.uniform(0.1, 0.35), rng.uniform(-0.17, 0.17), 0.0]) * distance
            place += [0.0, 0.0, BODY_HEIGHT]
            truth = turn(roll, pitch, yaw)
            image = photo(Scene(place, truth))
            imu = (roll + rng.normal(0, IMU_ERROR_RAD), pitch + rng.normal(0, IMU_ERROR_RAD))
            for told in (None, imu):
                pose = tracker.track(image, 0.0, told)
                row: dict[str, float | bool] = {"distance": distance, "tilt": tilt, "imu": told is not None}
                row["found"] = isinstance(pose, BodyPose)
                if isinstance(pose, BodyPose):
                    error = pose.position - place
                    row |= {
                        "xy": float(np.hypot(*error[:2])),
                        "z": float(abs(error[2])),
                        "yaw": abs(math.remainder(pose.yaw - math.atan2(truth[1, 0], truth[0, 0]), 2 * math.pi)),
                        "xy_stated": float(np.hypot(*pose.position_error[:2])),
                        "yaw_stated": pose.yaw_error,
                        "size_px": pose.size_px,
                        "margin": pose.margin,
                    }
                rows.append(row)
    return rows


def rms(rows: list[dict[str, float | bool]], key: str) -> float:
    """Root mean square of a column over the rows that have it."""
    values = [float(row[key]) for row in rows if key in row]
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else math.nan


def table(rows: list[dict[str, float | bool]], key: str, unit: str) -> str:
    """Rows of a Markdown table, one for each value of `key`."""
    lines = [
        f"| {unit} | found | tag, px | margin | xy, mm (stated) | z, mm | yaw, mrad (stated) |",
        "|---|---|---|---|---|---|---|",
    ]
    for value in sorted({row[key] for row in rows}):
        some = [row for row in rows if row[key] == value]
        found = [row for row in some if row["found"]]
        if not found:
            lines.append(f"| {value} | 0 of {len(some)} | | | | | |")
            continue
        margin = min(float(row["margin"]) for row in found)
        lines.append(
            f"| {value} | {len(found)} of {len(some)} | {rms(found, 'size_px'):.0f} | ≥ {margin:.0f} "
            f"| {1e3 * rms(found, 'xy'):.1f} ({1e3 * rms(found, 'xy_stated'):.1f}) | {1e3 * rms(found, 'z'):.1f} "
            f"| {1e3 * rms(found, 'yaw'):.1f} ({1e3 * rms(found, 'yaw_stated'):.1f}) |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=int, default=4, help="pictures for each family, distance and tilt")
    parser.add_argument("--family", action="append", help="only this family (repeat for several)")
    parser.add_argument("--json", type=Path, help="every picture's result")
    args = parser.parse_args()
    rng = np.random.default_rng(1)
    everything = {}
    for family in args.family or FAMILIES:
        rows = [row for distance in DISTANCES for row in measure(family, distance, args.pictures, rng)]
        everything[family] = rows
        with_imu = [row for row in rows if row["imu"]]
        print(f"\n### {family}\n\nby distance (all tilts, with IMU)\n\n{table(with_imu, 'distance', 'm')}")
        print(f"\nby tilt (all distances, with IMU)\n\n{table(with_imu, 'tilt', '°')}")
        print(f"\nby tilt, without IMU\n\n{table([row for row in rows if not row['imu']], 'tilt', '°')}", flush=True)
    if args.json:
        args.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
