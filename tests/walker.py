"""A builder at the terminal program: reads what the screens say and answers with keys, and watches the robot meanwhile."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import cast

from textual.pilot import Pilot
from textual.widgets import Input, Static

from openant_tools.procedure.step import Ask, Event, Intent
from openant_tools.tui.app import OpenAnt
from openant_tools.tui.choices import Choices
from openant_tools.tui.screens.step import StepScreen

#: of a test on a loaded machine
PATIENCE_S = 150.0
BY_HANDS, BY_ITSELF, GRANT, AGAIN = (
    "Let the virtual robot's hands do it",
    "It is done already",
    "Yes, do it",
    "Begin again",
)

#: what is done where a question comes up: the line to choose, the text to type, or something to do first
Reply = str | Callable[["Walker"], Awaitable[str | None]]


class Walker:
    """Answers as one does who trusts the program, unless told otherwise, and remembers every word of the screens.

    Args:
        replies: a part of a question, or of the last words before it → the line to choose, or what to do before one
            chooses as ever (or chooses the line that it returns).
        truth: what nobody may have changed before it was granted (torque and permanent memory of all servos).
    """

    def __init__(
        self,
        pilot: Pilot[int],
        replies: Mapping[str, Reply] | None = None,
        truth: Callable[[], object] | None = None,
    ) -> None:
        self.pilot, self.app = pilot, cast(OpenAnt, pilot.app)
        self.replies = dict(replies or {})
        self.truth = truth
        self.said = ""

    @property
    def screen(self) -> StepScreen:
        assert isinstance(self.app.screen, StepScreen), self.app.screen
        return self.app.screen

    @property
    def offered(self) -> list[str]:
        """The lines to choose from."""
        return [choice.words for choice in self.screen.choices]

    @property
    def log(self) -> str:
        """What stands in the step's log, and in its places for what to do and what was found."""
        lines = [
            *self.screen.query("#log Static").results(Static),
            *self.screen.query("#now, #found, #numbers").results(Static),
        ]
        return "\n".join(str(line.render()) for line in lines)

    def press(self, *keys: str) -> None:
        """Press keys; a pilot's own way waits until this process is idle, which it is not while a step works."""
        for key in keys:
            self.app.simulate_key(key)

    async def stop(self) -> str | None:
        """Press the stop key; the question that was open is gone when this ends."""
        asked = self._waits()
        self.press("space")
        await self.until(lambda: self._waits() is not asked)
        return None

    async def leave(self) -> None:
        """Let what was pressed be answered, before the screens are taken away.

        A key goes from the program to the widget in focus, and from there up to the program again if nobody wants it.
        """
        up = sorted(self.app.screen.walk_children(with_self=True), key=lambda one: len(one.ancestors), reverse=True)
        for pump in (self.app, *up, self.app):
            answered = asyncio.Event()
            if pump.call_later(answered.set):
                await asyncio.wait_for(answered.wait(), PATIENCE_S)

    async def until(self, what: Callable[[], bool]) -> None:
        give_up = time.monotonic() + PATIENCE_S
        while not what():
            assert time.monotonic() < give_up, self.log
            await asyncio.sleep(0.02)

    async def choose(self, words: str) -> None:
        """Go to the line that begins so, with the arrow keys, and press Enter."""
        await self.until(lambda: any(line.startswith(words) for line in self.offered))
        screen, shown = self.screen, self.screen.choices
        chooser = screen.query_one("#choices", Choices)
        at = next(k for k, line in enumerate(self.offered) if line.startswith(words))
        way = at - (chooser.highlighted or 0)
        self.press(*["down" if way > 0 else "up"] * abs(way), "enter")
        await self.until(lambda: self.app.screen is not screen or screen.choices is not shown)

    async def do(self, step: str) -> str:
        """Open a step, walk it to its end; what its log says."""
        self.app.open_step(step)
        await self.until(lambda: isinstance(self.app.screen, StepScreen) and bool(self.screen.choices))
        return await self.begin()

    async def begin(self, words: str = "Begin") -> str:
        """Begin the step that is open, and walk it to its end; what its log says."""
        untouched = self.truth() if self.truth is not None else None
        granted = False
        await self.choose(words)
        while True:
            await self.until(lambda: self._waits() is not None or not self.screen.running)
            event = self._waits()
            if event is None:
                self.said += self.log
                return self.log
            if self.truth is not None and not granted:
                assert self.truth() == untouched, f"changed before it was granted:\n{self.log}"
            granted |= isinstance(event, Intent)
            await self._answer(event)

    def _waits(self) -> Event | None:
        """The event that wants an answer, once the screen offers one."""
        screen = self.screen
        return screen._pending if screen.choices or screen.query_one("#value", Input).display else None

    async def _answer(self, event: Event) -> None:
        words = event.question if isinstance(event, Ask) else event.words  # type: ignore[union-attr]
        reply = next((reply for part, reply in self.replies.items() if part in words), None)
        if callable(reply):
            reply = await reply(self)
        if self._waits() is not event:
            return  # something else has ended it
        if isinstance(event, Ask) and not event.choices:
            field = self.screen.query_one("#value", Input)
            if reply is not None:
                field.value = reply
            self.press("enter")
        elif reply is not None:
            await self.choose(reply)
        elif isinstance(event, Ask):
            self.press("enter")  # what is marked is what is meant
        else:
            await self.choose(GRANT if isinstance(event, Intent) else BY_HANDS)
        await self.until(lambda: self._waits() is not event)


def walk(
    folder: Path,
    virtual: Mapping[str, str | None] | None,
    steps: Callable[[Walker], Awaitable[None]],
    replies: Mapping[str, Reply] | None = None,
    *,
    size: tuple[int, int],
    truth: Callable[[], object] | None = None,
) -> str:
    """Let a builder walk with the terminal program, at a virtual robot's addresses; all that it said."""
    said = []

    async def run() -> None:
        app = OpenAnt(folder, ticking=False)
        app.session.virtual = virtual
        try:
            async with app.run_test(size=size) as pilot:
                walker = Walker(pilot, replies, truth)
                await steps(walker)
                said.append(walker.said)
                await walker.leave()
        finally:
            app.session.close()

    asyncio.run(run())
    return said[0]
