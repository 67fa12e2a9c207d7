"""Keep the servos' EEPROM in a file, so that a virtual robot remembers its ids from one start to the next."""

from __future__ import annotations

import json
from pathlib import Path

from openant_tools.errors import BadInput
from openant_tools.files import read_json, write_text
from openant_tools.robot.registers import EEPROM_END
from openant_tools.virtual.servo_power import ServoSnapshot
from openant_tools.virtual.world import World

__all__ = ["EepromFile"]


class EepromFile:
    """A JSON file, joint → model, EEPROM and backup as hexadecimal bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def attach(self, world: World) -> None:
        """Load what the file has for this world's servos, and write every later change into it."""
        for joint, snapshot in self._read(world).items():
            world.servos[world.joints.index(joint)].load(snapshot)
        for servo in world.servos:
            servo.persist = lambda _: self.write(world)

    def write(self, world: World) -> None:
        content = {}
        for joint, servo in zip(world.joints, world.servos, strict=True):
            snapshot = servo.snapshot()
            content[joint] = {
                "model": servo.model.name,
                "eeprom": snapshot.eeprom.hex(),
                "backup": None if snapshot.backup is None else snapshot.backup.hex(),
            }
        write_text(self.path, json.dumps(content, indent=1) + "\n")

    def _read(self, world: World) -> dict[str, ServoSnapshot]:
        try:
            content = read_json(self.path, "remove it")
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise BadInput(f"not a file of EEPROMs ({error})", where=self.path, remedy="remove it") from None
        snapshots: dict[str, ServoSnapshot] = {}
        for joint, servo in zip(world.joints, world.servos, strict=True):
            entry = content.get(joint) if isinstance(content, dict) else None
            if entry is None:
                continue
            try:
                if entry.get("model") != servo.model.name:
                    continue
                eeprom, backup = bytes.fromhex(entry["eeprom"]), entry.get("backup")
                snapshots[joint] = ServoSnapshot(eeprom, None if backup is None else bytes.fromhex(backup))
            except (AttributeError, KeyError, ValueError, TypeError):
                raise BadInput(f"the EEPROM of {joint} is broken", where=self.path, remedy="remove the file") from None
            if len(eeprom) != EEPROM_END:
                raise BadInput(f"the EEPROM of {joint} is cut", where=self.path, remedy="remove the file")
        return snapshots
