"""`journal.jsonl` of a robot's folder: every write to a servo's permanent memory, with what stood there before."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from openant_tools.comms.servos import EepromWrite

__all__ = ["append_writes"]


def append_writes(path: Path, writes: Iterable[EepromWrite], command: str) -> None:
    """Add one line a write, in order; on the disk when this returns. `command` is what wrote it."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    lines = [json.dumps({"time": now, "command": command} | asdict(write)) for write in writes]
    if lines:
        with open(path, "a", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
            file.flush()
            os.fsync(file.fileno())
