"""Joints that a motion lets hang free while the others move: their torque off, followed, and caught where they hang."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.bus import Answer
from openant_tools.comms.motion import Motion, catch
from openant_tools.comms.servos import Block, Servos

__all__ = ["LimpJoints"]

Array = NDArray[np.float64]


class LimpJoints:
    """Which joints of one robot are limp.

    Args:
        rate_hz: of the loop.

    Attributes:
        now: (joints,), whose torque is off although the robot's is on.
        angles: (joints,) rad, where they were in the last cycle of a motion that lets joints go.
    """

    def __init__(self, servos: Servos, rate_hz: float) -> None:
        self._servos, self._rate_hz = servos, rate_hz
        self.now = np.zeros(len(servos.joints), bool)
        self.angles: Array = np.zeros(len(servos.joints))
        self._unconfirmed: list[str] = []

    def begin(self, angles: Array) -> None:
        """Torque has come on everywhere, at these angles, (joints,) rad."""
        self.angles = angles.copy()

    def end(self) -> None:
        """Torque is off everywhere."""
        self.now[:] = False
        self._unconfirmed = []

    def switch(self, motion: Motion) -> Array:
        """Torque of single joints as `motion` says; its row (joints,), in which a caught joint's goal is where it hangs."""
        servos, joints = self._servos, self._servos.joints
        before, self.now = self.now, motion.limp_now.copy()
        loose = [joint for joint, was, now in zip(joints, before, self.now, strict=True) if now and not was]
        if loose:
            # All at once, and just before the row that says so is read; who did not hear it is told alone after that.
            servos.write_all("torque_enable", dict.fromkeys(loose, 0))
            self._unconfirmed = loose
        caught = [joint for joint, was, now in zip(joints, before, self.now, strict=True) if was and not now]
        if caught:
            here = servos.read_all("present_position", caught)
            servos.write_all("goal_position", here)
            servos.set_torque(True, caught)
            for joint, counts in here.items():
                k, servo = joints.index(joint), servos[joint]
                angle = servo.to_joint(counts * servo.model.registers["present_position"].scale)
                catch(motion.commands, motion.done - 1, k, angle, self._rate_hz)
        row: Array = motion.commands[motion.done - 1]
        return row

    def make_sure(self) -> None:
        """Joints that were let go must be without torque, or the recording lies."""
        if self._unconfirmed:
            joints, self._unconfirmed = self._unconfirmed, []
            self._servos.set_torque(False, self._servos.still_on(joints))

    def see(self, answers: Sequence[tuple[Answer, Block | None]]) -> None:
        """Where the joints are in this cycle."""
        for k, (servo, (_, block)) in enumerate(zip(self._servos.servos, answers, strict=True)):
            if block is not None:
                self.angles[k] = servo.to_joint(block.position * servo.model.registers["present_position"].scale)
