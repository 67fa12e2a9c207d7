"""The card of an export: whose robot this is, as of when, calibrated how, and what its simulation was found to lack."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence

from openant_tools.errors import BadInput
from openant_tools.files import read_json
from openant_tools.numbers import number
from openant_tools.robot.folder import RobotFolder

__all__ = ["card"]


def card(title: str, folder: RobotFolder | None, runs: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """Markdown.

    Args:
        folder: the robot's, where there is one.
        runs: a line each on what was exported. notes: on what is not as it was recorded.
    """
    lines = [f"# {title}", "", f"Written by openant-tools on {datetime.datetime.now(datetime.UTC):%Y-%m-%d}.", ""]
    lines += [f"- **{name}**: {words}" for name, words in _robot(folder)]
    for heading, words in (("Of", runs), ("Not as it was recorded", notes)):
        lines += ["", f"## {heading}", "", *(f"- {line}" for line in words)] if words else []
    return "\n".join([*lines, ""])


def _robot(folder: RobotFolder | None) -> list[tuple[str, str]]:
    if folder is None:
        return [("robot", "not said"), ("calibration", "not known"), ("diagnosis", "none was made")]
    config = folder.config()
    servos = sorted({motor.model for motor in config.motors.values()})
    came = config.provenance_of("model")
    calibration = f"`{config.model}`"
    if came is None:
        calibration += ", nominal: nothing was fitted"
    else:
        calibration += f", {came.how}" + (f" on {came.date:%Y-%m-%d}" if came.date else "")
        calibration += f" by `{came.command}`" if came.command else ""
    return [
        ("robot", f"{config.name}, {config.kit} kit, {', '.join(servos)}"),
        ("calibration", calibration),
        ("diagnosis", _diagnosis(folder)),
    ]


def _diagnosis(folder: RobotFolder) -> str:
    for path in sorted(folder.diagnoses.glob("*.json"), reverse=True):
        try:
            found = read_json(path)
            gap, verdict = found["gap"], str(found["verdict"])
            before, after = float(gap["before"]), gap.get("after")
        except (OSError, BadInput, KeyError, TypeError, ValueError):
            continue
        words = f"{verdict} (`{path.name}`), gap {number(before, 'rad', name='gap')}"
        after = float(after) if isinstance(after, int | float) else math.nan
        return words + (f", {number(after, 'rad', name='gap')} with it" if math.isfinite(after) else "")
    return "none was made"
