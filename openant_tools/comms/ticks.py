"""A servo's own clock, its Realtime Tick, as the mark that tells to which question an answer belongs.

Answers of Protocol 2.0 carry no number. A block of registers that holds the tick carries the millisecond in which it
was read; held against the host's clock, that says whether it was read after the question was asked.
"""

from __future__ import annotations

__all__ = ["LATEST_S", "TICK_ADDRESS", "TICK_SIZE", "TickClock"]

#: How late an answer may be, beyond the time that it takes, and is still not taken for another's, s.
LATEST_S = 0.1

#: Register 120, ms, from 0 to 32767 (ROBOTIS e-manual).
TICK_ADDRESS, TICK_SIZE = 120, 2
_TICK_S = 1e-3
#: How fast the clocks of servo and host may drift apart: an oscillator without a crystal.
DRIFT = 0.02
#: A clock has proven itself once its ticks have kept step with the host's for so long, s.
PROOF_S = 0.05
#: After so long without an answer, s, it tells cycles of 100 Hz no more apart; and after so long it is too much to go on with.
VAGUE_S, LONGEST_GAP_S = 0.25, 1.0
#: So many answers in a row that cannot be: the servo has started anew.
STRIKES = 3


class TickClock:
    """One servo's ticks against the host's clock.

    The difference `servo − host` (s) lies between `low`, since no tick is read after its answer has arrived, and
    `high`, since none is read before it was asked for.

    Until it is proven, an answer out of step may be an earlier question's, or the one before it was, or the clock stands
    still: it is doubted, and answers that can only be their own questions' decide it.
    """

    __slots__ = ("_at", "_doubts", "_high", "_low", "_runs", "_since", "_strikes", "_tau", "_tick")

    def __init__(self) -> None:
        self._runs = True  # as far as is known
        self._at = self._since = float("-inf")  # host's time of the last answer and of the first in step, s
        self._tick, self._tau = 0, 0.0  # the last tick, and the servo's time unwrapped, s
        self._low = self._high = 0.0
        self._strikes = self._doubts = 0

    def usable(self, asked: float) -> bool:
        """Whether `stale` can be asked of an answer to a question asked at `asked` (s): it has been heard lately."""
        return self._runs and not self._doubts and asked - self._at < LONGEST_GAP_S

    def proven(self, asked: float) -> bool:
        """Whether it is usable, and is known to run."""
        return self.usable(asked) and self._at - self._since >= PROOF_S

    def decided_until(self, asked: float) -> float:
        """Until when (s) it is known whether it runs; the past where nobody knows."""
        if not self._runs:
            return asked + LONGEST_GAP_S
        return self._at + LONGEST_GAP_S if self.proven(asked) else float("-inf")

    def doubt(self, tick: int, asked: float, arrived: float) -> bool:
        """Whether an answer with this tick is out of step with the one before, of which nobody knows whether it was right."""
        if not self._runs or self._doubts or asked - self._at >= LONGEST_GAP_S or self.proven(asked):
            return False
        return self.stale(tick, asked, arrived)

    def vague(self, asked: float) -> bool:
        """Whether an answer that is not `stale` may nevertheless be one to a question shortly before."""
        return asked - self._at > VAGUE_S

    def stale(self, tick: int, asked: float, arrived: float) -> bool:
        """Whether an answer with this tick cannot have been read between `asked` and `arrived` (s); only where `usable`."""
        ahead = (tick - self._tick) & 0x7FFF
        tau = self._tau + (ahead if ahead < 0x4000 else ahead - 0x8000) * _TICK_S
        slack = DRIFT * (asked - self._at)
        return tau + _TICK_S - self._low + slack < asked or tau - self._high - slack > arrived

    def follow(self, tick: int, asked: float, arrived: float) -> bool:
        """Take in an answer to a question asked at `asked` that arrived at `arrived` (s); False where it cannot be one,
        by a clock that is known to run."""
        passed = asked - self._at
        if passed < LONGEST_GAP_S:
            ahead = (tick - self._tick) & 0x7FFF
            tau = self._tau + (ahead if ahead < 0x4000 else ahead - 0x8000) * _TICK_S
            slack = DRIFT * passed
            low, high = self._low - slack, self._high + slack
            first, last = tau - arrived, tau + _TICK_S - asked
            if first <= high and last >= low:
                self._low, self._high = first if first > low else low, last if last < high else high
                self._tick, self._tau, self._at = tick, tau, asked
                self._strikes = 0
                if asked - self._since >= PROOF_S:
                    self._runs, self._doubts = True, 0
                return True
            if self._runs and not self._doubts:
                self._doubts += not self.proven(asked)
                return False
            # The first answer after the doubt: the same tick as before, or all begins anew with it.
            self._runs = self._runs and self._doubts < 2 and tick != self._tick
            self._doubts = min(self._doubts + 1, 2)
        # The first answer, or one out of step with those before: a clock that stands still, or began anew.
        self._tick, self._tau, self._strikes = tick, 0.0, 0
        self._at = self._since = asked
        self._low, self._high = -arrived, _TICK_S - asked
        return True

    def strike(self) -> None:
        """An answer came that cannot be, and none beside it: several in a row, and the clock must prove itself again."""
        self._strikes += 1
        if self._strikes >= STRIKES:
            self._at = self._since = float("-inf")
            self._runs, self._strikes, self._doubts = False, 0, 0
