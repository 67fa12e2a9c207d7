"""Which answers may still come: they could pass for the answers to later questions.

Answers of Protocol 2.0 carry no number. One that is late belongs to whoever asked before, and looks like the answer to
the next question of the same servo and length. So every question is remembered for as long as an answer may be late,
`LATEST_S`; a question whose answer could be mistaken waits until that has passed.
"""

from __future__ import annotations

from collections.abc import Callable

from openant_tools.comms.faults import Cause
from openant_tools.comms.reply import Answer, ReplyPlan, Request, Shape
from openant_tools.comms.ticks import LATEST_S

__all__ = ["LATEST_S", "Pending"]

#: For so long after an answer too many, s, a question also waits where the one before was answered.
DISTRUST_S = 60.0
#: A servo that has not been heard for so long, s, is waited for by nobody.
HEARD_S = 1.0


class Pending:
    """The questions of the last `LATEST_S` of one bus."""

    def __init__(self) -> None:
        #: id → form of the answer → until when one may come that is owed to an earlier question, s
        self._owed: dict[int, dict[Shape, float]] = {}
        self._owed_until = 0.0
        #: (id, form of the answer) → the last question that was answered: its packet, and until when that may come twice
        self._asked: dict[tuple[int, Shape], tuple[bytes, float]] = {}
        self._heard: dict[int, float] = {}
        self._distrust_until = 0.0

    def plan(
        self, request: Request, now: float, told: Callable[[int], bool], undecided: bool = False
    ) -> ReplyPlan | None:
        """What asking this now needs; None where nothing does.

        Args:
            told: whether a servo's own clock tells which question its answer belongs to.
            undecided: it asks for the clock of a servo of which nobody knows yet whether it runs.
        """
        by_clock = request.tick_at is not None and not undecided
        if by_clock and now >= self._owed_until:
            return None
        wait, listen, doubtful, refusing = now, False, set[int](), dict[int, float]()
        for id, shape in zip(request.ids, request.shapes, strict=True):
            owed = self._owed.get(id)
            if owed is not None and now < self._owed_until:
                # A refusal has no data, so that its length does not tell to which question it is.
                latest = max(owed.values())
                until = latest if request.alone else owed.get(shape, 0.0)
                refusing[id] = latest
                if until > now:
                    by_tick = request.tick_at is not None and told(id)
                    if request.alone or (not by_tick and now - self._heard.get(id, now) < HEARD_S):
                        wait = max(wait, until)
                    else:
                        doubtful.add(id)
            before = self._asked.get((id, shape))
            if before is not None and before[1] > now and not by_clock:
                if now < self._distrust_until:
                    wait = max(wait, before[1])
                elif before[0] != request.packet:
                    listen = True
        may_refuse = frozenset(id for id, until in refusing.items() if until > wait)
        return ReplyPlan(wait, listen, frozenset(doubtful), may_refuse) if wait > now or listen or may_refuse else None

    def answered(self, request: Request, started: float, undecided: bool = False) -> None:
        """All of them, each once."""
        self._heard.update(dict.fromkeys(request.ids, started))
        if request.tick_at is None or undecided:
            entry = request.packet, started + request.whole + LATEST_S
            self._asked |= dict.fromkeys(zip(request.ids, request.shapes, strict=True), entry)

    def note(self, request: Request, answers: list[Answer], started: float, *, surplus: bool) -> None:
        """What became of a question; `surplus` where answers came that were none to it."""
        until = started + request.whole + LATEST_S
        for answer, shape in zip(answers, request.shapes, strict=True):
            if answer.data is not None or answer.cause is Cause.LATE:
                self._heard[answer.id] = started
            if answer.data is not None:
                self._asked[answer.id, shape] = request.packet, until
            if answer.data is None or answer.refusal:
                self._heard.setdefault(answer.id, started)
                self._owed.setdefault(answer.id, {})[shape] = until
                self._owed_until = max(self._owed_until, until)
        if surplus:
            self.distrust(started)

    def distrust(self, now: float) -> None:
        """An answer came that nobody waited for: it may be anybody's, and others may follow."""
        self._distrust_until = now + DISTRUST_S
