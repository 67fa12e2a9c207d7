"""What is set in the servos that the engine owns, how it differs from what should be, and what it allows to command."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.engine_port import EnginePort
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.servos import Servos
from openant_tools.comms.state import POSITION, RECORDED, Difference, differences, expected, read_state
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number

__all__ = ["ServoSettings"]


class ServoSettings:
    """Registers as they were read last.

    Attributes:
        registers: joint → register → counts.
        ours: joint → register → counts that a face has set, in place of what was expected.
        differences: from what is expected, what makes a motion wrong first.

    Raises:
        HardwareFault: a servo does not answer.
    """

    def __init__(self, config: EngineConfig, port: EnginePort, servos: Servos) -> None:
        self._config, self._port, self._servos = config, port, servos
        self.ours: dict[str, dict[str, int]] = {joint: dict(table) for joint, table in config.registers.items()}
        self.registers: dict[str, dict[str, int]] = {}
        self.differences: list[Difference] = []
        self.read()

    def read(self) -> list[Difference]:
        """Read them anew; the differences that were not there before."""
        config, servos, before = self._config, self._servos.servos, set(self.differences)
        self.registers = read_state(self._servos, self._at_work())
        wanted = {
            servo.joint: expected(
                servo.model, ours=self.ours.get(servo.joint, {}), passport=config.passport.get(servo.joint, {})
            )
            for servo in servos
        }
        for joint in wanted:  # set when something is to move, whatever stands there now
            if "pwm_limit" not in self.ours.get(joint, {}):
                wanted[joint].pop("pwm_limit", None)
        found = differences(servos, self.registers, wanted, config.limits_rad)
        # What a gentle motion left of it is raised whenever torque comes on.
        self.differences = [one for one in found if one.register != "goal_pwm"]
        return [difference for difference in self.differences if difference not in before]

    def _at_work(self) -> Iterator[str]:
        for register in RECORDED:
            self._port.busy_reading()
            yield register

    def check_goals(self, commands: NDArray[np.float64]) -> None:
        """In position mode a servo refuses goals beyond its own limits, and nobody would be told.

        Args:
            commands: (n, joints) rad.

        Raises:
            HardwareFault: one of them lies beyond.
        """
        if self._config.anyway:
            return
        for k, servo in enumerate(self._servos.servos):
            table = self.registers[servo.joint]
            if table["operating_mode"] != POSITION:
                continue
            ends = commands[:, k].min(), commands[:, k].max()
            scale = servo.model.registers["goal_position"].scale
            counts = [(round(servo.to_servo(angle) / scale), angle) for angle in ends]
            for name, outside in (
                ("min_position_limit", [angle for count, angle in counts if count < table["min_position_limit"]]),
                ("max_position_limit", [angle for count, angle in counts if count > table["max_position_limit"]]),
            ):
                if outside:
                    end = servo.to_joint(table[name] * scale)
                    raise HardwareFault(
                        f"{servo.called} would be sent to {number(outside[0], 'rad', decimals=2)}, but refuses goals beyond "
                        f"{number(end, 'rad', decimals=2)}: its {name} is {table[name]}",
                        where=self._config.port,
                        remedy="widen it by `openant calib inventory`, or narrow this joint's limits in robot.toml",
                    )
