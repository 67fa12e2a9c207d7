"""A procedure in a thread of its own, with the terminal program as its face."""

from __future__ import annotations

import contextlib
import queue
import threading
import traceback
from collections.abc import Callable
from pathlib import Path

from openant_tools.bringup.simulated_builder import SimulatedBuilder
from openant_tools.errors import OpenAntError, system_fault
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.step import Answer, Ask, Bench, Declined, Event, Hands, Intent, Live, Step, drive

__all__ = ["BY_VIRTUAL_HANDS", "StepRun"]

#: in the robot's folder: what should never have happened, for a report
ERRORS = "errors.log"
#: a reply to `Hands`: the virtual robot's hands are to do it
BY_VIRTUAL_HANDS = "virtual hands"


class _Ended(Declined):
    """The builder left or pressed the stop key."""

    def __init__(self, why: str) -> None:
        super().__init__(why, remedy="torque is off; what was found so far is kept, the step can be begun again")


class StepRun:
    """One run of a step, whose finding is kept in the robot's folder. The callbacks are called in its thread.

    Args:
        show: for each event.
        done: with the finding, or None and why there is none.
    """

    def __init__(
        self, step: Step, bench: Bench, show: Callable[[Event], None], done: Callable[[Finding | None, str], None]
    ) -> None:
        self.step = step
        self._bench = bench
        self._show = show
        self._done = done
        self._answers: queue.Queue[Answer | _Ended] = queue.Queue()
        self._ended: _Ended | None = None
        self._enough = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"step {step.name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def reply(self, answer: Answer) -> None:
        """What the builder said to the event that waits."""
        self._answers.put(answer)

    def enough(self) -> None:
        """The builder has seen enough of what is live."""
        self._enough.set()

    def end(self, why: str) -> None:
        """End it in order at its next word; torque goes off."""
        self._ended = _Ended(why)
        self._answers.put(self._ended)

    def join(self, timeout_s: float) -> bool:
        """Wait for its end; whether it has ended."""
        self._thread.join(timeout_s)
        return not self.running

    def answer(self, event: Event) -> Answer:
        """The procedure's side: show, and wait where an answer is wanted."""
        if self._ended is not None:
            raise self._ended
        self._show(event)
        if isinstance(event, Live):
            seen = self._enough.is_set()
            self._enough.clear()
            return seen
        self._enough.clear()  # a key that was pressed before counts for nothing that comes later
        if isinstance(event, Hands) and event.while_watching and self._bench.control is not None:
            self._do_virtually(event)
        elif isinstance(event, Intent | Ask) or (isinstance(event, Hands) and not event.while_watching):
            answer = self._answers.get()
            if isinstance(answer, _Ended):
                raise answer
            if isinstance(event, Hands) and answer == BY_VIRTUAL_HANDS:
                self._do_virtually(event)
                return True
            return answer
        return None

    def _do_virtually(self, event: Hands) -> None:
        assert self._bench.control is not None
        hands = SimulatedBuilder(self._bench.control)
        try:
            hands.do(event)
        finally:
            hands.close()

    def _run(self) -> None:
        try:
            with self._bench.folder.hold():
                finding = drive(self.step.start(self._bench), self)
                if self._ended is not None:  # what was stopped has seen less than it says
                    raise self._ended
                keep(finding, self._bench.folder, virtual=self._bench.virtual)
        except (OpenAntError, OSError) as error:
            # Of what was ended from here that is the reason, whatever broke off by it.
            self._done(None, str(self._ended or _ours(error, self._bench.folder.path)))
        except ModuleNotFoundError as error:
            self._done(None, f"this step needs the package {error.name}, which is not installed")
        except Exception as error:  # a fault of the program: the builder sees it, torque is off, the file has the rest
            log = self._bench.folder.path / ERRORS
            with contextlib.suppress(OSError), log.open("a", encoding="utf-8") as file:  # a full disk keeps no more
                traceback.print_exc(file=file)
            self._done(None, f"{type(error).__name__}: {error} → this is a fault of the program; please report {log}")
        else:
            self._done(finding, "")


def _ours(error: OpenAntError | OSError, folder: Path) -> OpenAntError:
    return system_fault(error, where=folder, again="begin the step again") if isinstance(error, OSError) else error
