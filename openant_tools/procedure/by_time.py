"""Parts of what only takes time (a soak): its minutes, so that it goes on with the next one where it was left."""

from __future__ import annotations

import math
from typing import Any, TypeVar

from openant_tools.procedure.step import Answer, Progress, Subroutine
from openant_tools.procedure.unfinished import Parts

__all__ = ["minutes", "noted"]

T = TypeVar("T")


def minutes(seconds: float) -> tuple[str, ...]:
    """`minute 1`, `minute 2`, …: parts of so many s, equally long."""
    return tuple(f"minute {k + 1}" for k in range(max(1, math.ceil(seconds / 60))))


def noted(work: Subroutine[T], parts: Parts, **facts: Any) -> Subroutine[T]:
    """Do the work, and note each part, with these facts, once its progress is past it; its result."""
    answer: Answer = None
    past = 0
    try:
        while True:
            event = work.send(answer)
            if isinstance(event, Progress) and event.share is not None:
                while past < int(event.share * len(parts.of) + 1e-9):
                    parts.done(parts.of[past], **facts)
                    past += 1
            answer = yield event
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        work.close()
