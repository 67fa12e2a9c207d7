"""Where the robot is: its body tag in the frame of the arena's origin tag, from one picture.

Frames: a tag's x is its up-direction, y its left, z out of the paper; the arena's frame is the origin tag's. Body axes
are x forward, y left, z up; how the body tag sits in them is the mount (`position` of its centre, `yaw`).

The estimate. Corner noise of a small tag leaks into its tilt, and through the lever arm between tag and body centre
into position. So the pose is the most likely one given the four corners *and* a prior on tilt: level to within
`TILT_PRIOR_RAD`, or as the IMU says where the caller passes it. The prior also decides between the two poses that a
flat square always allows; where they stay in doubt, the doubt is in the reported errors. Those are of this estimate and
of the origin's, with the corner noise that this camera's residuals show; they do not know a wrong lens or a wrongly
declared edge length.

The origin tag does not move, so its corners are averaged over many pictures (median, far ones left out) before its pose
is computed once; it may then be covered. If it is seen elsewhere for a while, the camera was bumped: poses stop until
the new place is certain.

The body tag is found in this very picture or the robot is **lost**, with the reason. No pose is ever held. Nor is one
given where a picture can be read in two ways: two sheets with one tag, a picture of another size, an origin that is
remembered from another view or looks larger than before (a zoom or a crop, which no lens of ours is for), a body higher than
one can stand or leaning otherwise than the IMU says, a tag that is suddenly elsewhere.
"""

from __future__ import annotations

import math
import re
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.doubts import View, other_reading
from openant_tools.comms.intrinsics import Intrinsics
from openant_tools.comms.tag_family import load_family
from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number
from openant_tools.optional import cv2

__all__ = ["BodyLost", "BodyPose", "BodyTracker", "Sighting", "TagDetector", "TagSetup", "tag_pose"]

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

#: Corner error of a tag in focus, one standard deviation each way, until this camera's own is known from residuals.
CORNER_PX = 0.1
#: Whatever the residuals say: neighbouring corners err alike, which no residual shows.
CORNER_MIN_PX = 0.04
#: pictures over which it is known, and before which it is not believed
CORNER_MEMORY = 200
CORNER_WARM_UP = 20
#: Median of chi² with two degrees of freedom (eight coordinates, six unknowns).
CHI2_2_MEDIAN = 1.386
#: What does not average out: lens blur over unequal surroundings.
CORNER_BIAS_PX = 0.04
#: A walking Open Ant tilts by a few degrees.
TILT_PRIOR_RAD = math.radians(8.0)
#: The flight controller's attitude while the body is shaken.
IMU_TILT_RAD = math.radians(2.0)
#: Degrees of freedom of the prior (Student's t): its tails let clear corners overrule it, as on a body that tips over.
PRIOR_FREEDOM = 3.0
#: A square that fits its corners worse than this is not that square.
MAX_RESIDUAL_PX = 2.0
#: pictures over which the origin is averaged, and the fewest for one
ORIGIN_MEMORY = 60
ORIGIN_MIN = 5
#: The origin tag seen this far from where it was, this many pictures running: something was moved.
ORIGIN_MOVED_PX = 2.0
ORIGIN_MOVED_PICTURES = 10
#: Found elsewhere, it is as far from the camera as before within this share, or the picture has another scale.
ORIGIN_SAME_SHARE = 0.06
#: and leans as it did within this, rad: a picture that is stretched by 2 % makes so much of a square.
ORIGIN_SAME_LEAN_RAD = math.radians(10.0)
#: A second sheet with the same number: not much smaller or paler than the first, or it is a pattern that looks like one.
#: s after which one that is not seen any more is gone
TWIN_SHARE, TWIN_S = 0.25, 10.0
#: Between two pictures a robot goes so far at most, m and m/s; beyond, so many pictures must agree on where it is.
JUMP_M, JUMP_M_S, JUMP_PICTURES = 0.10, 3.0, 10
#: The tag's lean and the IMU's differ by less, rad: corners of a small tag err by a few degrees.
LEAN_APART_RAD = math.radians(25.0)
#: Pictures without a tag after which it is asked why.
ASK_WHY = 15
#: s after which the whole picture is searched again, for a second sheet; meanwhile both tags are looked for where they were, in a box that is
#: wider by so many edge lengths on each side: a fraction of the work, and of the time until a pose is known
WHOLE_S, AROUND = 0.09, 1.5
#: px that boxes begin at a multiple of: the detector's tiles lie as they do in the whole picture, however it is decimated
TILE_PX = 24

# Tag axes (up, left, out) in the frame that IPPE_SQUARE wants (right, up, out).
_IPPE_FROM_TAG = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class TagSetup:
    """Which tags there are and where the body's is mounted.

    Attributes:
        origin_size, body_size: edge length in m (`tag_family` says which square that is).
        body_position: centre of the body tag in the body, m. body_yaw: its up-direction against the body's x, rad.
        min_margin: what the detector must be sure of; upstream accepts 2.
        heights: of the body's origin over the floor, m, between which it can be.
        edge: share of the picture's width and height, on each side, that counts as its edge.
        decimate: quads are searched in a picture this much smaller, corners refined in the whole one. At 2 the families
            with many cells get lost below 20 px (benchmarks/tag_pose.py).
    """

    family: str = "tagCircle21h7"
    origin_id: int = 0
    body_id: int = 12
    origin_size: float = 0.10
    body_size: float = 0.045
    body_position: tuple[float, float, float] = (0.0, 0.0, 0.085)
    body_yaw: float = 0.0
    min_margin: float = 5.0
    heights: tuple[float, float] = (-0.05, 0.45)
    edge: float = 0.10
    decimate: float = 1.5

    def __post_init__(self) -> None:
        known = len(load_family(self.family).codes)
        for name, tag in (("origin", self.origin_id), ("body", self.body_id)):
            if not 0 <= tag < known:
                raise BadInput(f"{self.family} has no tag {tag} ({name})", remedy=f"its ids are 0 to {known - 1}")
        if self.origin_id == self.body_id:
            raise BadInput(f"origin and body cannot both be tag {self.body_id}", remedy="give the body another tag")
        for name, size in (("origin", self.origin_size), ("body", self.body_size)):
            if not 0.005 <= size <= 1.0:
                raise BadInput(
                    f"the {name} tag's edge length is {exact(size, 'm')}", remedy="measure it; most are 0.03 to 0.2 m"
                )


@dataclass(frozen=True)
class Sighting:
    """A tag in a picture: corners (4, 2) in OpenCV's pixels, top left first, then clockwise as the tag is read.

    The detector names the nearest code that is up to two wrong bits away (`hamming`), which of `tag16h5`, whose codes differ
    by five, may be another tag's. Here a tag with any wrong bit has no place: for one to be taken for another, as many cells
    as the family's codes differ by must be misread at once, seven of 21 of `tagCircle21h7`, and each the right way.
    """

    id: int
    corners: Array
    margin: float
    hamming: int

    @property
    def size_px(self) -> float:
        """Mean length of the four edges."""
        return float(np.mean(np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=0), axis=1)))


class TagDetector:
    """pyapriltags' detector for one family. Not for use by two threads at once."""

    def __init__(self, family: str, *, decimate: float = 1.5, threads: int = 1) -> None:
        from pyapriltags import Detector

        load_family(family)
        # Without edge refinement corners are off by a tenth to a fifth of a pixel, five times what they are with it.
        self._detector = Detector(families=family, nthreads=threads, quad_decimate=decimate, refine_edges=1)

    def detect(self, gray: Gray) -> list[Sighting]:
        """All tags in a grey picture (h, w)."""
        found = self._detector.detect(np.ascontiguousarray(gray))
        # The library counts from the picture's corner, OpenCV from the first pixel's centre.
        return [
            Sighting(int(d.tag_id), np.asarray(d.corners[::-1], float) - 0.5, float(d.decision_margin), int(d.hamming))
            for d in found
        ]

    def around(self, gray: Gray, last: Sighting) -> list[Sighting]:
        """The same tag, also more than once, near where it was last."""
        reach = AROUND * last.size_px
        first = np.floor((last.corners.min(axis=0) - reach) / TILE_PX).astype(int).clip(0) * TILE_PX
        end = np.ceil(last.corners.max(axis=0) + reach).astype(int)
        found = self.detect(gray[first[1] : end[1], first[0] : end[0]])
        return [replace(one, corners=one.corners + first) for one in found if one.id == last.id]


@dataclass(frozen=True)
class BodyPose:
    """The body in the arena.

    Attributes:
        t: when the picture was taken, s.
        position: of the body's origin, m. rotation: 3 × 3, arena from body.
        yaw: heading of the body's x axis, rad, counter-clockwise.
        position_error, yaw_error: one standard deviation, m and rad.
        near_edge: the tag is in the outer part of the picture, where the next step may lose it.
        residual_px: root mean square distance of the corners from where the pose puts them.
        size_px, margin: of the tag in the picture; small values foretell a loss.
        detection_s: computing time.
    """

    t: float
    position: Array
    rotation: Array
    yaw: float
    position_error: Array
    yaw_error: float
    near_edge: bool
    residual_px: float
    size_px: float
    margin: float
    detection_s: float

    @property
    def kind(self) -> str:
        """As that of `BodyLost`: nothing is wrong."""
        return ""

    @property
    def heading(self) -> Array:
        """The body's x axis in the floor, a unit vector (2,)."""
        return np.array([math.cos(self.yaw), math.sin(self.yaw)])

    @property
    def quaternion(self) -> Array:
        """The rotation as w x y z, w ≥ 0."""
        vector = np.asarray(cv2.Rodrigues(self.rotation)[0], float).ravel()
        angle = float(np.linalg.norm(vector))
        axis = vector / angle if angle > 0 else vector
        return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis])


@dataclass(frozen=True)
class BodyLost:
    """No pose from this picture, and why."""

    t: float
    reason: str

    @property
    def kind(self) -> str:
        """The reason without its figures, which change from picture to picture."""
        return re.sub(r"[\d.]+", "", self.reason)


class BodyTracker:
    """Follows the body tag from picture to picture.

    Args:
        setup: the tags.
        intrinsics: the lens; scaled to the pictures' size where that differs.

    Attributes:
        origin_moves: how often the origin tag was found elsewhere than before.
    """

    def __init__(self, setup: TagSetup, intrinsics: Intrinsics, *, threads: int = 1) -> None:
        self.setup = setup
        self.origin_moves = 0
        self._intrinsics = intrinsics
        self._detector = TagDetector(setup.family, decimate=setup.decimate, threads=threads)
        self._seen: deque[Array] = deque(maxlen=ORIGIN_MEMORY)
        self._elsewhere: list[Array] = []
        self._origin: _Origin | None = None
        self._misfits: deque[float] = deque(maxlen=CORNER_MEMORY)
        self._size: tuple[int, int] | None = None
        self._twin: tuple[float, str] = (-math.inf, "")
        self._view: View | None = None
        self._view_moved = False
        self._camera: tuple[float, Array] | None = None
        self._scaled = ""
        self._last: tuple[float, Array] | None = None
        self._jumped = 0
        self._jump_words = ""
        self._unread, self._why = 0, ""
        self._whole_t = -math.inf
        self._near: tuple[Sighting, ...] = ()

    @property
    def origin(self) -> tuple[Array, Array] | None:
        """Rotation (3, 3) and translation (3,) m, camera from arena; None until it is certain."""
        return None if self._origin is None else (self._origin.rotation, self._origin.position)

    def track(
        self, picture: NDArray[np.uint8], t: float, tilt: tuple[float, float] | None = None
    ) -> BodyPose | BodyLost:
        """The body in one picture, grey (h, w) or colour (h, w, 3), taken at `t`.

        Args:
            tilt: roll and pitch of the body in rad from the IMU at `t`, where there is one.

        Raises:
            BadInput: the picture has another shape than the lens was calibrated for.
        """
        began = time.perf_counter()
        setup = self.setup
        gray = picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
        size = (gray.shape[1], gray.shape[0])
        if self._size is not None and size != self._size:
            before = "×".join(map(str, self._size))
            return BodyLost(
                t, f"the picture is {size[0]}×{size[1]} now, it was {before}: another mode, crop or turn of the camera"
            )
        lens = self._intrinsics.scaled(*size)
        self._size = size
        sightings = self._sightings(gray, t)
        for which, tag in (("origin", setup.origin_id), ("body", setup.body_id)):
            if _twins(sightings, tag, setup):
                self._twin = (t, f"{which} tag {tag} is seen twice: take the other sheet with this number away")
        if abs(t - self._twin[0]) < TWIN_S:
            return BodyLost(t, self._twin[1])
        origin = best(sightings, setup.origin_id, setup)
        self._note_origin(origin, lens, t)
        seen = best(sightings, setup.body_id, setup)
        self._near = () if origin is None or seen is None else (origin, seen)
        self._unread = 0 if origin is not None and seen is not None else self._unread + 1
        if self._elsewhere:
            return BodyLost(t, "the origin tag or the camera has moved")
        if self._origin is None:
            return BodyLost(t, self._why_not(sightings, "origin") + self._other_reading(gray))
        if self._scaled:
            return BodyLost(t, self._scaled)
        body = None if seen is None else (*seen.corners.mean(axis=0).tolist(), seen.size_px)
        if origin is not None:
            if body is not None or self._view is None:  # else legs could stand anywhere
                self._view = View(gray, body)
            self._view_moved = False
        elif self._view is not None:
            # What was once seen elsewhere has moved, however little texture the next picture shows.
            self._view_moved = self._view_moved or self._view.moved(gray, body)
        if self._view_moved:
            return BodyLost(t, f"the view has moved while origin tag {setup.origin_id} was hidden: uncover it")
        if seen is None:
            return BodyLost(t, self._why_not(sightings, "body") + self._other_reading(gray))
        return self._steady(self._pose(seen, lens, t, tilt, began))

    def _sightings(self, gray: Gray, t: float) -> list[Sighting]:
        """The tags in a picture: of one soon after another that showed both, these two, else all of them."""
        if self._near and 0.0 <= t - self._whole_t < WHOLE_S:
            again = [one for last in self._near for one in self._detector.around(gray, last)]
            if all(best(again, last.id, self.setup) for last in self._near):
                return again
        self._whole_t = t
        return self._detector.detect(gray)

    def _other_reading(self, gray: Gray) -> str:
        """What else the picture may be, looked at now and then while tags are missing."""
        if not self._unread:
            self._why = ""
        elif self._unread % ASK_WHY == 1 and self._unread > 1:
            why = other_reading(gray, self.setup.family, (self.setup.origin_id, self.setup.body_id))
            self._why = f"; {why}" if why else ""
        return self._why

    def _steady(self, found: BodyPose | BodyLost) -> BodyPose | BodyLost:
        """The pose, unless it is farther from the last one than a robot goes; until enough pictures agree on it."""
        if isinstance(found, BodyLost):
            return found
        if self._last is not None:
            before, place = self._last
            gone = float(np.linalg.norm(found.position - place))
            if gone > JUMP_M + JUMP_M_S * max(0.0, found.t - before):
                self._jumped = 1
                self._last = (found.t, found.position)
                away, ago = number(gone, "m", decimals=2), number(found.t - before, "s")
                words = f"body tag {self.setup.body_id} was {away} away {ago} ago"
                self._jump_words = f"{words}: another sheet with its number, or was the robot carried?"
                return BodyLost(found.t, self._jump_words)
        self._last = (found.t, found.position)
        if self._jumped:
            self._jumped = 0 if self._jumped >= JUMP_PICTURES else self._jumped + 1
            if self._jumped:
                return BodyLost(found.t, self._jump_words)
        return found

    def _why_not(self, sightings: list[Sighting], which: Literal["origin", "body"]) -> str:
        """Why one of the two tags has no place in a picture."""
        ids = {"origin": self.setup.origin_id, "body": self.setup.body_id}
        named = f"{which} tag {ids[which]}"
        doubtful = [s for s in sightings if s.id == ids[which]]
        # An origin that is read well is asked for in some more pictures, and one picture is soon read amiss.
        if doubtful and best(sightings, ids[which], self.setup) is None and self._unread > 1:
            s = max(doubtful, key=lambda s: s.margin)
            if s.hamming and s.margin >= self.setup.min_margin:
                return f"{named} is doubtful (wrong bits: {s.hamming}): a spot, a crease or a shadow on it"
            how = f"margin {number(s.margin, decimals=1)}, wrong bits: {s.hamming}"
            return f"{named} is doubtful ({how}): too small, too dark or blurred"
        sure = {s.id for s in sightings if s.margin >= self.setup.min_margin and s.hamming == 0}
        others = ", ".join(map(str, sorted(sure - set(ids.values()))))
        return f"{named} not seen{' yet' if which == 'origin' else ''}" + (f" (but tag {others})" if others else "")

    @property
    def corner_noise_px(self) -> float:
        """Corner error of this camera, from how the corners of late miss the best square."""
        if len(self._misfits) < CORNER_WARM_UP:
            return CORNER_PX
        return max(CORNER_MIN_PX, math.sqrt(float(np.median(self._misfits)) / CHI2_2_MEDIAN))

    # --- the arena -------------------------------------------------------------------------------------------------

    def _note_origin(self, seen: Sighting | None, lens: Intrinsics, t: float) -> None:
        if seen is None:
            return
        if self._seen:
            middle = np.median(self._seen, axis=0)
            if np.abs(seen.corners - middle).max() > ORIGIN_MOVED_PX:
                self._elsewhere.append(seen.corners)
                if len(self._elsewhere) >= ORIGIN_MOVED_PICTURES:
                    self._seen = deque(self._elsewhere[-ORIGIN_MIN:], maxlen=ORIGIN_MEMORY)
                    self._elsewhere = []
                    self._origin = None
                    self._last, self._jumped = None, 0
                    self.origin_moves += 1
                    self._solve_origin(lens, moved=True)
                return
        self._elsewhere = []
        self._seen.append(seen.corners)
        # The average settles: solved anew only while it still gains.
        if self._origin is None or len(self._seen) < ORIGIN_MEMORY:
            self._solve_origin(lens)

    def _solve_origin(self, lens: Intrinsics, *, moved: bool = False) -> None:
        if len(self._seen) < ORIGIN_MIN:
            return
        corners = np.asarray(self._seen)
        middle = np.median(corners, axis=0)
        near = np.abs(corners - middle).max(axis=(1, 2)) < ORIGIN_MOVED_PX / 2
        mean = corners[near].mean(axis=0) if near.any() else middle
        poses = tag_pose(mean, self.setup.origin_size, lens)
        if poses:
            noise = max(self.corner_noise_px / math.sqrt(max(1, int(near.sum()))), CORNER_BIAS_PX)
            fit = refine(*poses[0], mean, self.setup.origin_size, lens, None, noise)
            self._origin = _Origin(fit.rotation, fit.position, fit.covariance)
            # A flat square seen from far allows two poses: either may be the one that it had before.
            self._judge_scale(fit, [fit.rotation[:, 2], *(rotation[:, 2] for rotation, _ in poses)], moved)

    def _judge_scale(self, fit: _Fit, ups: list[Array], moved: bool) -> None:
        """A camera that was pushed aside is as far from the origin as before; one that zooms or crops seems nearer, one that
        stretches its picture seems to look from the side."""
        far_m = float(np.linalg.norm(fit.position))
        if self._camera is None or not (moved or self._scaled):
            self._camera = far_m, ups[0]
            return
        before_m, before_up = self._camera
        turned = math.acos(max(-1.0, min(1.0, max(float(up @ before_up) for up in ups))))
        self._scaled = ""
        if abs(far_m / before_m - 1) > ORIGIN_SAME_SHARE:
            self._scaled = f"looks {number(before_m / far_m, decimals=2)} times as large as before"
        elif turned > ORIGIN_SAME_LEAN_RAD:
            self._scaled = f"leans by {number(turned, 'rad', decimals=0)} otherwise than before"
        if self._scaled:
            self._scaled = (
                f"origin tag {self.setup.origin_id} {self._scaled}: the camera zooms, crops, stretches its picture or hangs elsewhere; start "
                "it again"
            )

    # --- the body --------------------------------------------------------------------------------------------------

    def _pose(
        self, seen: Sighting, lens: Intrinsics, t: float, tilt: tuple[float, float] | None, began: float
    ) -> BodyPose | BodyLost:
        origin = self._origin
        assert origin is not None
        setup = self.setup
        c, s = math.cos(setup.body_yaw), math.sin(setup.body_yaw)
        body_from_tag = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        up = origin.rotation[:, 2]
        prior = _Prior(_up_in_tag(tilt, body_from_tag), up, TILT_PRIOR_RAD if tilt is None else IMU_TILT_RAD)
        solutions = [
            refine(rotation, position, seen.corners, setup.body_size, lens, prior, self.corner_noise_px)
            for rotation, position in tag_pose(seen.corners, setup.body_size, lens)
        ]
        if not solutions:
            return BodyLost(t, f"the corners of body tag {setup.body_id} make no square")
        fit, *other = sorted(solutions, key=lambda solution: solution.cost)
        if fit.residual_px > MAX_RESIDUAL_PX:
            return BodyLost(
                t,
                f"the corners of body tag {setup.body_id} make no square ({number(fit.residual_px, 'px', decimals=1)} off)",
            )

        self._misfits.append(4 * fit.residual_px**2)

        def body(fit: _Fit, tag: Array, arena: Array) -> tuple[Array, Array, float]:
            """Rotation, position and yaw once tag and arena are moved a little (rotation vector and shift, 6 each)."""
            r_arena = _exp(arena[:3]) @ origin.rotation
            rotation = r_arena.T @ _exp(tag[:3]) @ fit.rotation @ body_from_tag.T
            centre = r_arena.T @ (fit.position + tag[3:] - origin.position - arena[3:])
            place = centre - rotation @ np.asarray(setup.body_position)
            return rotation, place, math.atan2(rotation[1, 0], rotation[0, 0])

        still = np.zeros(6)
        rotation, position, yaw = body(fit, still, still)
        if rotation[2, 2] <= 0.0:
            return BodyLost(t, f"body tag {setup.body_id} is seen from below: the body lies on its back")
        low, high = setup.heights
        if not low <= position[2] <= high:
            return BodyLost(
                t, f"the body would be {number(position[2], 'm', decimals=2)} above the floor: is it carried, or are a tag's size, the lens or the "
                "picture's size other than declared?"
            )  # fmt: skip
        if tilt is not None:
            lean = fit.rotation @ prior.up_tag @ up
            apart = math.acos(max(-1.0, min(1.0, float(lean))))
            if apart > LEAN_APART_RAD:
                return BodyLost(
                    t, f"the tag leans by {number(apart, 'rad', decimals=0)} otherwise than the IMU says: a stretched picture, or is `openant "
                    "calib imu` still to be done?"
                )  # fmt: skip
        variance = np.zeros(4)
        step = 1e-6
        for which, covariance in enumerate((fit.covariance, origin.covariance)):
            jacobian = np.empty((4, 6))
            for k in range(6):
                moved = np.eye(6)[k] * step
                _, p, turned = body(fit, moved, still) if which == 0 else body(fit, still, moved)
                jacobian[:, k] = np.append(p - position, math.remainder(turned - yaw, 2 * math.pi)) / step
            variance += np.diag(jacobian @ covariance @ jacobian.T)
        for rival in other:
            # The other pose of a flat square, weighed by its likelihood.
            _, p, turned = body(rival, still, still)
            doubt = 1.0 / (1.0 + math.exp(min(50.0, (rival.cost - fit.cost) / 2.0)))
            variance += doubt * np.append(p - position, math.remainder(turned - yaw, 2 * math.pi)) ** 2
        errors = np.sqrt(variance)
        centre = seen.corners.mean(axis=0) / [lens.width, lens.height]
        return BodyPose(
            t=t,
            position=position,
            rotation=rotation,
            yaw=yaw,
            position_error=errors[:3],
            yaw_error=float(errors[3]),
            near_edge=bool(np.any((centre < setup.edge) | (centre > 1.0 - setup.edge))),
            residual_px=fit.residual_px,
            size_px=seen.size_px,
            margin=seen.margin,
            detection_s=time.perf_counter() - began,
        )


def best(sightings: list[Sighting], tag: int, setup: TagSetup) -> Sighting | None:
    """The surest sighting of a tag that passes the gates."""
    return max(_sure(sightings, tag, setup), key=lambda s: s.margin, default=None)


def _sure(sightings: list[Sighting], tag: int, setup: TagSetup) -> list[Sighting]:
    return [s for s in sightings if s.id == tag and s.margin >= setup.min_margin and s.hamming == 0]


def _twins(sightings: list[Sighting], tag: int, setup: TagSetup) -> bool:
    """Whether a picture shows two sheets with one number."""
    surest = best(sightings, tag, setup)
    return surest is not None and any(
        s is not surest
        and s.margin > TWIN_SHARE * surest.margin
        and TWIN_SHARE < s.size_px / surest.size_px < 1 / TWIN_SHARE
        and float(np.linalg.norm(s.corners.mean(axis=0) - surest.corners.mean(axis=0))) > surest.size_px / 2
        for s in _sure(sightings, tag, setup)
    )


# --- poses -------------------------------------------------------------------------------------------------------


def tag_points(size: float) -> Array:
    """Corners (4, 3) in the tag's frame, in the order of `Sighting.corners`, m."""
    h = size / 2.0
    return np.array([[h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0], [-h, h, 0.0]])


def tag_pose(corners: Array, size: float, lens: Intrinsics) -> list[tuple[Array, Array]]:
    """The one or two poses (rotation 3 × 3, position 3; camera from tag) of a square, best first (IPPE).

    Args:
        corners: (4, 2), as in `Sighting`.
        size: edge length, m.
    """
    rays = lens.rays(corners)
    points = tag_points(size) @ _IPPE_FROM_TAG.T
    count, rotations, positions, _ = cv2.solvePnPGeneric(
        points, rays.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    poses = []
    for k in range(int(count)):
        rotation = np.asarray(cv2.Rodrigues(rotations[k])[0], float) @ _IPPE_FROM_TAG
        position = np.asarray(positions[k], float).ravel()
        if position[2] > 0 and np.all(np.isfinite(rotation)):
            poses.append((rotation, position))
    return poses


@dataclass(frozen=True)
class _Prior:
    """The direction `up_tag` (in the tag) should be `up_camera` (in the camera), to within `sigma` rad each way."""

    up_tag: Array
    up_camera: Array
    sigma: float


@dataclass(frozen=True)
class _Origin:
    """The arena's frame: camera from arena, and its covariance as in `refine`."""

    rotation: Array
    position: Array
    covariance: Array


@dataclass(frozen=True)
class _Fit:
    rotation: Array
    position: Array
    covariance: Array
    cost: float
    residual_px: float


def refine(
    rotation: Array,
    position: Array,
    corners: Array,
    size: float,
    lens: Intrinsics,
    prior: _Prior | None,
    noise_px: float = CORNER_PX,
) -> _Fit:
    """The most likely pose near a first one: Gauss–Newton on corners and tilt, with its covariance (6 × 6).

    Parameters are a small rotation in the camera's axes and the position. Residuals are corner distances over
    `noise_px`, and with a prior the two components of the tilt over its sigma.
    """
    points = tag_points(size)
    focal = np.array([lens.fx, lens.fy])
    rays = lens.rays(corners)
    # Any two axes across the prior's direction span the tilt; without a prior it weighs nothing.
    if prior is None:
        prior = _Prior(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), math.inf)
    across = np.linalg.svd(prior.up_camera[None, :])[2][1:]

    def residuals(r: Array, p: Array) -> Array:
        seen = points @ r.T + p
        pixels = ((seen[:, :2] / seen[:, 2:] - rays) * focal).ravel()
        lean = across @ (r @ prior.up_tag - prior.up_camera)
        return np.concatenate([pixels / noise_px, lean / prior.sigma])

    def cost(r: Array) -> float:
        """Minus twice the log likelihood: Gaussian corners, Student's t for the tilt."""
        lean = float(r[8:] @ r[8:])
        return float(r[:8] @ r[:8]) + (PRIOR_FREEDOM + 2.0) * math.log1p(lean / PRIOR_FREEDOM)

    def weighted(r: Array) -> Array:
        """Weights of the residuals with which least squares has the same slope as `cost`."""
        weights = np.ones(10)
        weights[8:] = (PRIOR_FREEDOM + 2.0) / (PRIOR_FREEDOM + float(r[8:] @ r[8:]))
        return weights

    now = residuals(rotation, position)
    damping = 1e-3
    for _ in range(30):
        jacobian = _jacobian(rotation, position, points, focal, across, prior, noise_px)
        slope = jacobian.T * weighted(now)
        normal = slope @ jacobian
        step = np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -slope @ now), float)
        trial = (_exp(step[:3]) @ rotation, position + step[3:])
        then = residuals(*trial)
        gained = cost(now) - cost(then)
        if gained > 0:
            rotation, position, now = trial[0], trial[1], then
            damping = max(damping / 5, 1e-9)
            if gained < 1e-6:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    jacobian = _jacobian(rotation, position, points, focal, across, prior, noise_px)
    covariance = np.asarray(np.linalg.pinv((jacobian.T * weighted(now)) @ jacobian), float)
    residual = float(np.sqrt(np.mean((now[:8] * noise_px) ** 2) * 2))
    return _Fit(rotation, position, covariance, cost(now), residual)


def _jacobian(r: Array, p: Array, points: Array, focal: Array, across: Array, prior: _Prior, noise_px: float) -> Array:
    """Derivatives (10, 6) of the residuals of `refine`."""
    turned = points @ r.T
    seen = turned + p
    z = seen[:, 2]
    rows = np.zeros((4, 2, 3))
    rows[:, 0, 0] = focal[0] / z
    rows[:, 1, 1] = focal[1] / z
    rows[:, 0, 2] = -focal[0] * seen[:, 0] / z**2
    rows[:, 1, 2] = -focal[1] * seen[:, 1] / z**2
    out = np.empty((10, 6))
    out[:8, 3:] = rows.reshape(8, 3) / noise_px
    for k in range(4):
        out[2 * k : 2 * k + 2, :3] = -rows[k] @ _cross(turned[k]) / noise_px
    out[8:, :3] = -across @ _cross(r @ prior.up_tag) / prior.sigma
    out[8:, 3:] = 0.0
    return out


def _up_in_tag(tilt: tuple[float, float] | None, body_from_tag: Array) -> Array:
    """The vertical in the tag's frame, for a body with this roll and pitch (level without)."""
    if tilt is None:
        return np.array([0.0, 0.0, 1.0])
    roll, pitch = tilt
    up = [-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)]
    return np.asarray(body_from_tag.T @ up)


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _exp(w: Array) -> Array:
    """Rotation matrix of a rotation vector."""
    return np.asarray(cv2.Rodrigues(np.asarray(w, float))[0], float)
