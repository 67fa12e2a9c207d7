"""What makes a pose from a picture doubtful although every tag was read well: the view has moved, the picture is mirrored.

A still camera sees its floor in the same place, whatever moves on it. Where the origin's tag is hidden, that is the only
witness: the picture is cut into cells, and the floor in each is looked for around where it was when the tag was last seen
(normalised cross-correlation, the light's slow slopes taken out). Cells that the robot covers are left out.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.tag_family import load_family
from openant_tools.optional import cv2

__all__ = ["View", "other_reading"]

Gray = NDArray[np.uint8]

#: Width of the picture in which cells are compared, px; cells along both sides; how far the floor is looked for.
WIDTH, COLUMNS, ROWS, REACH = 480, 5, 3, 20
#: px of the reduced picture: what is wider than this is light and shade; grey levels beyond which an edge counts no more.
SLOW_PX, MOST = 5.0, 8.0
#: Standard deviation of the grey levels of a floor that has texture: noise leaves less once the picture is reduced.
TEXTURE = 2.0
#: Elsewhere by so many px, found again so surely, and by so much better than where it was: the floor has moved.
MOVED_PX, FOUND, BETTER = 1.5, 0.4, 0.1
#: Legs reach so many edges of the body's tag away from it.
LEGS = 6.0
#: Families that are sold and printed most.
COMMON = ("tagCircle21h7", "tag36h11", "tag25h9", "tag16h5")
#: What a tag of no family in use must be sure of, so that no pattern of a floor is taken for one.
SURE_MARGIN = 25.0


class View:
    """The floor as a camera saw it at one time.

    Args:
        gray: the picture (h, w).
        body: centre x and y of the body's tag in it and the length of its edge, px; None where it is not seen.
    """

    def __init__(self, gray: Gray, body: tuple[float, float, float] | None) -> None:
        self._gray, self._body = gray, _reduced(body, gray)

    @cached_property
    def _floor(self) -> NDArray[np.float32]:
        return _floor(self._gray)

    def moved(self, gray: Gray, body: tuple[float, float, float] | None) -> bool:
        """Whether the camera shows that floor elsewhere in its picture; no where there is too little texture to tell."""
        now, bodies = _floor(gray), [one for one in (self._body, _reduced(body, gray)) if one is not None]
        height, width = now.shape
        for row in range(ROWS):
            for column in range(COLUMNS):
                x0, x1 = (REACH + (column + k) * (width - 2 * REACH) // COLUMNS for k in (0, 1))
                y0, y1 = (REACH + (row + k) * (height - 2 * REACH) // ROWS for k in (0, 1))
                cell = now[y0:y1, x0:x1]
                covered = any(
                    max(x0 - x, x - x1, 0) ** 2 + max(y0 - y, y - y1, 0) ** 2 < (LEGS * edge) ** 2
                    for x, y, edge in bodies
                )
                if covered or float(cell.std()) < TEXTURE:
                    continue
                around = self._floor[y0 - REACH : y1 + REACH, x0 - REACH : x1 + REACH]
                match = cv2.matchTemplate(around, cell, cv2.TM_CCOEFF_NORMED)
                _, found, _, (x, y) = cv2.minMaxLoc(match)
                away = max(abs(x - REACH), abs(y - REACH))
                if away > MOVED_PX and found > FOUND and found - float(match[REACH, REACH]) > BETTER:
                    return True
        return False


def _floor(gray: Gray) -> NDArray[np.float32]:
    height = round(gray.shape[0] * WIDTH / gray.shape[1])
    small = cv2.resize(gray, (WIDTH, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(np.clip(small - cv2.GaussianBlur(small, (0, 0), SLOW_PX), -MOST, MOST), np.float32)


def _reduced(body: tuple[float, float, float] | None, gray: Gray) -> tuple[float, float, float] | None:
    if body is None:
        return None
    share = WIDTH / gray.shape[1]
    return body[0] * share, body[1] * share, body[2] * share


def other_reading(gray: Gray, family: str, wanted: tuple[int, ...]) -> str:
    """Why tags that should be there are not read, as far as another reading of the picture tells; "" where none does.

    Args:
        family: that was looked for. wanted: the tags of it.
    """
    from openant_tools.comms.tags import TagDetector

    def seen(picture: Gray, family: str) -> set[int]:
        found = TagDetector(family).detect(picture)
        return {one.id for one in found if one.hamming == 0 and one.margin >= SURE_MARGIN}

    if seen(np.ascontiguousarray(gray[:, ::-1]), family) & set(wanted):
        return "the picture is mirrored: switch that off in the camera's settings"
    for other in COMMON:
        if other == family or not load_family(other).codes:
            continue
        ids = seen(gray, other)
        if ids:
            named = ", ".join(map(str, sorted(ids)))
            return f"tag {named} of the family {other} is there: is camera.tag_family = {family!r} right?"
    return ""
