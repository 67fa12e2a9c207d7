"""The builder of a virtual robot: what a procedure asks of hands, done through its control socket."""

from __future__ import annotations

import time
from collections.abc import Mapping

from openant_tools.comms.clock import VirtualControl
from openant_tools.procedure.step import Hands
from openant_tools.robot.joints import JOINT_NAMES

__all__ = ["SimulatedBuilder"]

#: s until servos that were just powered answer
POWER_UP_S = 1.0
#: s that hands take for each stretch of a motion
TURN_S, TILT_S = 0.8, 1.0


class SimulatedBuilder:
    """Hands that do at once, or begin, what they are asked to.

    Args:
        control: the virtual robot's control socket.
        mistakes: joint → the joint that is taken instead, for a builder who mixes them up.
    """

    def __init__(self, control: str, mistakes: Mapping[str, str] | None = None) -> None:
        self._remote = VirtualControl(control)
        self._mistakes = dict(mistakes or {})

    def do(self, hands: Hands) -> None:
        """Do one task; motions begin here and go on as the robot's time does."""
        joint = self._mistakes.get(hands.joint, hands.joint)
        match hands.task:
            case "plug" | "unplug":
                for name in (joint,) if joint else JOINT_NAMES:
                    self._remote.ask(hands.task, joint=name)
            case "assemble":
                self._remote.ask("assemble", setup=hands.setup or "stand")
            case "straighten":
                for name in JOINT_NAMES:
                    self._remote.ask("turn", joint=name, to=[0.0], leg_s=TURN_S)
            case "turn":
                self._remote.ask("turn", joint=joint, to=list(hands.path_rad), leg_s=TURN_S)
            case "tilt":
                if self._remote.ask("state")["setup"] == "floor":  # left there by a step that broke off
                    self._remote.ask("assemble", setup="stand")
                self._remote.ask("tilt", rotation_rad=list(hands.path_rad), seconds=TILT_S)
            case "place":
                self._remote.ask("assemble", setup=hands.setup)
            case "free":
                self._remote.ask("let_go")

    def resume(self, assembled: bool) -> None:
        """Put a robot that was just started back to where the walk had got: out of its box, if it was built."""
        if assembled and self._remote.ask("state")["setup"] == "loose":
            self._remote.ask("assemble", setup="stand")
            now = self._remote.ask("now")
            if now["stepped"]:
                self._remote.ask("advance", to=now["t"] + POWER_UP_S)
            else:
                time.sleep(POWER_UP_S)

    def close(self) -> None:
        self._remote.close()
