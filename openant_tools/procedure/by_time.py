"""Parts of what only takes time (a soak): its minutes, so that it goes on with the next one where it was left."""

from __future__ import annotations

import math
from typing import Any, TypeVar

from openant_tools.procedure.relay import passing
from openant_tools.procedure.step import Event, Progress, Subroutine
from openant_tools.procedure.unfinished import Parts

__all__ = ["minutes", "noted"]

T = TypeVar("T")

#: s of a part
PART_S = 60


def minutes(seconds: float) -> tuple[str, ...]:
    """`minute 1`, `minute 2`, …: parts of so many s, equally long."""
    return tuple(f"minute {k + 1}" for k in range(max(1, math.ceil(seconds / PART_S))))


def noted(work: Subroutine[T], parts: Parts, **facts: Any) -> Subroutine[T]:
    """Do the work, and note each part, with these facts, once its progress is past it; its result."""
    past = 0

    def note(event: Event) -> Event:
        nonlocal past
        share = event.share if isinstance(event, Progress) else None
        while past < int((share or 0.0) * len(parts.of) + 1e-9):
            parts.done(parts.of[past], **facts)
            past += 1
        return event

    return passing(work, note)
