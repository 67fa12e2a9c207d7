"""Every command that moves with each of its processes killed while it holds torque: rows for docs/reliability.md."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from campaign import Campaign

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from killing import OFF_S, WAYS, NotBegun, Victim, torque_after_kill

__all__ = ["campaigns"]


def campaigns() -> list[Campaign]:
    """One row a victim; try k kills command k, in turn."""

    def kill(victim: Victim, k: int) -> bool:
        name = list(WAYS)[k % len(WAYS)]
        for _ in range(5):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    return torque_after_kill(name, (victim,), Path(folder))[victim] <= OFF_S
                except NotBegun:
                    continue  # nothing was killed, or this computer was too busy to tell
                except AssertionError:
                    return False
        raise NotBegun(name)

    words = {
        "command": "`kill -9` of a command that moves: torque off within 0.5 s",
        "engine": "`kill -9` of its engine: torque off within 0.5 s",
        "guardian": "`kill -9` of its guardian: another one within 0.5 s, or torque off",
        "guardian+engine": "`kill -9` of guardian and engine together: motion stops within 0.5 s",
    }
    return [
        Campaign(text, len(WAYS), lambda k, victim=victim: kill(victim, k))  # type: ignore[misc]
        for victim, text in words.items()
    ]
