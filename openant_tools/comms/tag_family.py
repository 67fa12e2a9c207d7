"""AprilTag families as the detector's own library knows them: codes and bit layout, and a tag's bitmap made from them.

The tables live in the C library that pyapriltags ships; they are read from there at run time, so that what is printed
or rendered is by construction what the detector looks for.

A tag's **edge length** is the side of the square whose corners the detector reports. For the classic families that is
the black square; for the circular and standard ones it is the inner square between white and black ring, smaller than
the printed tag (`tagCircle21h7`: 5 of 9 cells).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput

__all__ = ["FAMILIES", "TagFamily", "load_family"]

#: Families that the library's Python face can make; 21h7 is what existing Open Ants wear.
FAMILIES = (
    "tagCircle21h7",
    "tag36h11",
    "tag25h9",
    "tag16h5",
    "tagStandard41h12",
    "tagStandard52h13",
    "tagCircle49h12",
    "tagCustom48h12",
)


@dataclass(frozen=True)
class TagFamily:
    """One family.

    Attributes:
        codes: one code word a tag id.
        cells: cells along the side of the whole bitmap. edge_cells: along the side of the detected square.
        reversed_border: the detected square is white inside and black outside.
        bits: column and row of each bit, most significant first, counted from the detected square's corner cell.
        hamming: least distance between two codes, bits.
    """

    name: str
    codes: tuple[int, ...]
    cells: int
    edge_cells: int
    reversed_border: bool
    bits: tuple[tuple[int, int], ...]
    hamming: int

    def bitmap(self, tag_id: int) -> NDArray[np.uint8]:
        """The tag as printed: (cells, cells), 0 black and 255 white, row 0 at the top.

        Raises:
            BadInput: the family has no such id.
        """
        if not 0 <= tag_id < len(self.codes):
            raise BadInput(f"{self.name} has no tag {tag_id}", remedy=f"its ids are 0 to {len(self.codes) - 1}")
        image = np.full((self.cells, self.cells), 255, np.uint8)
        corner = (self.cells - self.edge_cells) // 2
        # A black ring of one cell: outside the detected square where the border is reversed, within it otherwise.
        low = corner - 1 if self.reversed_border else corner
        high = self.cells - 1 - low
        image[low, low : high + 1] = image[high, low : high + 1] = 0
        image[low : high + 1, low] = image[low : high + 1, high] = 0
        code = self.codes[tag_id]
        for index, (x, y) in enumerate(self.bits):
            white = code >> (len(self.bits) - 1 - index) & 1
            image[corner + y, corner + x] = 255 * white
        return image


@cache
def load_family(name: str) -> TagFamily:
    """The family called `name`.

    Raises:
        BadInput: there is no such family.
    """
    from pyapriltags import Detector

    if name not in FAMILIES:
        raise BadInput(f"there is no tag family {name!r}", remedy=f"known: {', '.join(FAMILIES)}")
    detector = Detector(families=name)
    raw = detector.tag_families[name].contents
    return TagFamily(
        name=name,
        codes=tuple(int(raw.codes[k]) for k in range(raw.ncodes)),
        cells=int(raw.total_width),
        edge_cells=int(raw.width_at_border),
        reversed_border=bool(raw.reversed_border),
        bits=tuple((int(raw.bit_x[k]), int(raw.bit_y[k])) for k in range(raw.nbits)),
        hamming=int(raw.h),
    )
