"""The 24 observations of the Open Ant and the orders in which people write them down.

One observation is made of five blocks: joint positions (rad) and velocities (rad/s), a planar direction (unit
vector), the torso's specific force (m/s², +9.81 on z at rest) and its angular velocity (rad/s), both in the body frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["ORDERS", "Block", "ObservationLayout", "layout"]

#: block, named as in run tables → size, None where it is one number a joint.
BLOCKS: Mapping[str, int | None] = {
    "pos": None,
    "vel": None,
    "direction": 2,
    "acc": 3,
    "gyro": 3,
}
Block = str

#: name → the blocks in order. `platform`: the published software. `paper`: the order of the paper's sentence.
ORDERS: Mapping[str, tuple[Block, ...]] = {
    "platform": ("pos", "vel", "direction", "acc", "gyro"),
    "paper": ("pos", "vel", "gyro", "acc", "direction"),
}


@dataclass(frozen=True)
class ObservationLayout:
    """Where each block stands in an observation.

    Attributes:
        order: the name in `ORDERS`.
        slices: block → its place.
        names: one name a number, such as `pos.hip_rr` or `acc.z`: the columns of run tables, where there is one.
    """

    order: str
    slices: Mapping[Block, slice]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)


def layout(joints: Sequence[str], order: str = "platform") -> ObservationLayout:
    """The layout of an observation of these joints.

    Args:
        joints: joint names in the order of the actions.
        order: a name in `ORDERS`.

    Raises:
        KeyError: no such order.
    """
    axes = {2: ("along", "left"), 3: ("x", "y", "z")}
    slices: dict[Block, slice] = {}
    names: list[str] = []
    for block in ORDERS[order]:
        size = BLOCKS[block]
        parts = tuple(joints) if size is None else axes[size]
        slices[block] = slice(len(names), len(names) + len(parts))
        names += [f"{block}.{part}" for part in parts]
    return ObservationLayout(order, slices, tuple(names))
