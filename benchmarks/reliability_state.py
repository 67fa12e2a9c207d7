"""Servos as other software left them: rows for docs/reliability.md."""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from campaign import Campaign

from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINT_NAMES

__all__ = ["campaigns"]

#: register → a value that some other program may leave in it
LEFT: dict[str, Callable[[random.Random], int]] = {
    "min_position_limit": lambda chance: chance.randrange(1500, 2300),
    "max_position_limit": lambda chance: chance.randrange(1800, 2600),
    "profile_velocity": lambda chance: chance.randrange(1, 40),
    "profile_acceleration": lambda chance: chance.randrange(1, 40),
    "drive_mode": lambda chance: chance.choice((1, 4, 5, 8, 9)),
    "homing_offset": lambda chance: chance.choice((-1, 1)) * chance.randrange(100, 1000),
    "operating_mode": lambda chance: chance.choice((1, 16)),
    "pwm_limit": lambda chance: chance.randrange(20, 885),
    "goal_pwm": lambda chance: chance.randrange(5, 300),
    "position_p_gain": lambda chance: chance.randrange(0, 200),
    "position_d_gain": lambda chance: chance.randrange(2000, 16000),
    "feedforward_1st_gain": lambda chance: chance.randrange(100, 16000),
    "velocity_limit": lambda chance: chance.randrange(1, 40),
    "moving_threshold": lambda chance: chance.randrange(20, 1000),
    "secondary_id": lambda chance: chance.choice((10, 11, 20, 21, 30, 31, 40, 41, 77)),
    "shutdown": lambda chance: chance.randrange(0, 64),
    "status_return_level": lambda chance: chance.choice((0, 1)),
    "torque_enable": lambda chance: 1,
}
#: farther from its command than this, rad, a joint at rest has not followed
FOLLOWED_RAD = 0.15


def campaigns() -> list[Campaign]:
    """One row a register."""
    return [
        Campaign(
            f"other software left any value in `{register}` of any joint: `sysid record` names it before anything is recorded, "
            "or every joint follows all the same",
            2,
            lambda k, register=register: _told_or_harmless(register, k),  # type: ignore[misc]
        )
        for register in LEFT
    ]


def _told_or_harmless(register: str, seed: int) -> bool:
    chance = random.Random(f"{register} {seed}")
    joint, value = chance.choice(JOINT_NAMES), LEFT[register](chance)
    with tempfile.TemporaryDirectory() as folder:
        scenario, out = Path(folder, "left.toml"), Path(folder, "run.mcap")
        scenario.write_text(f'[camera]\npresent = false\n[[servo]]\njoint = "{joint}"\n{register} = {value}\n')
        ran = subprocess.run(
            [sys.executable, "-m", "openant_tools.cli", "sysid", "record", "--virtual", str(scenario), "--protocol", "stand",
             "--seconds", "8", "--out", str(out), "--yes"],
            capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=300, check=False,
        )  # fmt: skip
        said = ran.stdout + ran.stderr
        named = register in said or register.replace("_", " ") in said.lower()
        if "Traceback" in said:
            return False
        if ran.returncode:
            return named and joint in said
        run = read_run(str(out))
        rest = np.arange(len(run.t)) > len(run.t) - 20
        apart = [
            abs(float(np.nanmean((run.columns[f"cmd.{one}"] - run.columns[f"pos.{one}"])[rest]))) for one in JOINT_NAMES
        ]
        return max(apart) < FOLLOWED_RAD
