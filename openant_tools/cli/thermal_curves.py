"""Temperatures while a soak for heat goes on, as curves that stay in place."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from rich.console import Group
from rich.live import Live as Screen
from rich.table import Table

from openant_tools.cli.face import CommandFace
from openant_tools.numbers import number, percent
from openant_tools.procedure.step import Answer, Event, Live, Progress

__all__ = ["Curves"]

_BARS = "▁▂▃▄▅▆▇█"
_PLAIN_BARS = "_.,-=+*#"
#: points of a live curve
CURVE = 32
#: s between two drawings of the live table, and between two lines where no terminal is attached
DRAW_S, LINE_S = 0.25, 20.0


class Curves(CommandFace):
    """As any procedure is shown, and what lives as curves: newest values, and each servo's temperature so far as a strip."""

    def __init__(self, *, yes: bool) -> None:
        super().__init__(yes=yes)
        self._bars = _BARS if (self.console.encoding or "").lower().startswith("utf") else _PLAIN_BARS
        self._past: dict[str, list[float]] = {}
        self._doing, self._at = "", -math.inf
        self.table = Screen(console=self.console, auto_refresh=False, transient=True)

    def answer(self, event: Event) -> Answer:
        if isinstance(event, Progress):
            self._doing = f"{event.words}, {percent(event.share or 0.0)}"
            if self.console.is_terminal:
                return None
        return super().answer(event)

    def _show(self, live: Live) -> bool:
        for joint, value in live.values.items():
            self._past.setdefault(joint, []).append(value)
        terminal, now = self.console.is_terminal, time.monotonic()
        if now - self._at > (DRAW_S if terminal else LINE_S):
            self._at = now
            if terminal:
                self.table.update(self._drawn(live), refresh=True)
            elif live.values:
                warmest = max(live.values, key=lambda joint: live.values[joint] - live.high[joint])
                self._line(f"{self._doing}: {warmest} {self._of(live, warmest)} °C")
        return super()._show(replace(live, low={}))

    def _drawn(self, live: Live) -> Group:
        table = Table("servo", "°C", "", "so far", box=None)
        for joint, value in live.values.items():
            left = live.high[joint] - value
            colour = "red" if left <= 5 else "yellow" if left <= 15 else "default"
            now = f"[{colour}]{self._of(live, joint)}[/{colour}]"
            table.add_row(joint, now, live.marks.get(joint, ""), self._strip(joint, live.high[joint]))
        return Group(f"[bold]{self._doing}[/bold], {live.words}", table)

    @staticmethod
    def _of(live: Live, joint: str) -> str:
        """`43 of 72`."""
        return f"{number(live.values[joint], decimals=0)} of {number(live.high[joint], decimals=0)}"

    def _strip(self, joint: str, limit: float) -> str:
        """From the coldest reading to the limit."""
        past = self._past[joint]
        values = past[:: max(1, len(past) // CURVE)]
        low, steps = min(values), len(self._bars) - 1
        return "".join(self._bars[min(steps, max(0, round((v - low) / max(limit - low, 1.0) * steps)))] for v in values)
