"""Work that reports by a callback, as a procedure: it runs in a thread, its progress comes as events. And work as a part of a
procedure: how far it is, as a share of the whole."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import TypeVar

from openant_tools.procedure.step import Answer, Event, Progress, Subroutine

__all__ = ["part_of", "passing", "relayed", "within"]

T = TypeVar("T")


class _Cancelled(Exception):
    """Raised inside the work, where it next reports: whatever it has open is put into order on the way out."""


def relayed(work: Callable[[Callable[[float, str], None]], T]) -> Subroutine[T]:
    """Run `work(progress)` and yield what it reports; its result.

    A face that closes the procedure ends the work at its next report. What the work raises is raised here.
    """
    events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
    cancelled, outcome, failure = threading.Event(), list[T](), list[BaseException]()

    def progress(share: float, words: str) -> None:
        if cancelled.is_set():
            raise _Cancelled
        events.put(Progress(share, words))

    def run() -> None:
        try:
            outcome.append(work(progress))
        except BaseException as error:
            failure.append(error)
        finally:
            events.put(None)

    thread = threading.Thread(target=run, name="procedure's work", daemon=True)
    thread.start()
    try:
        while (event := events.get()) is not None:
            yield event
    finally:
        cancelled.set()
        thread.join()
    if failure:
        raise failure[0]
    return outcome[0]


def passing(work: Subroutine[T], change: Callable[[Event], Event]) -> Subroutine[T]:
    """Do the work, and pass on what it yields as `change` has it; its result."""
    answer: Answer = None
    try:
        while True:
            answer = yield change(work.send(answer))
    except StopIteration as ended:
        result: T = ended.value
        return result
    finally:
        work.close()


def within(part: tuple[float, float], work: Subroutine[T]) -> Subroutine[T]:
    """Do the work as this part, from share to share, of a procedure, whose progress never goes back; its result."""
    begin, end = part

    def place(event: Event) -> Event:
        if isinstance(event, Progress) and event.share is not None:
            return Progress(begin + event.share * (end - begin), event.words)
        return event

    return passing(work, place)


def part_of(
    progress: Callable[[float, str], None], number: int, count: int, before: str = ""
) -> Callable[[float, str], None]:
    """What one of `count` equal parts of work, `number` from 0, tells its progress to; `before` stands before its words."""
    return lambda share, words: progress((number + share) / count, before + words)
