"""Jump mode: a letter stands on everything that can be gone to; pressing it goes there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Protocol, runtime_checkable

from textual import events
from textual.app import ComposeResult
from textual.geometry import Offset
from textual.screen import ModalScreen, Screen
from textual.widget import Widget
from textual.widgets import Label

__all__ = ["Jump", "JumpPoints"]

LETTERS = "asdfghjklqwertyuiopzxcvbnm"


@runtime_checkable
class JumpPoints(Protocol):
    """A widget with more than one place to go to."""

    def jump_points(self) -> Iterable[tuple[Offset, Callable[[], None]]]:
        """Where on the screen each letter stands, and what going there does."""
        ...


class Jump(ModalScreen[None]):
    """The letters over the screen below."""

    DEFAULT_CSS = """
    Jump { background: $background 40%; }
    Jump Label { position: absolute; background: $warning; color: black; text-style: bold; padding: 0 1; width: 3; }
    """

    def __init__(self, below: Screen[object]) -> None:
        super().__init__()
        points = [point for widget in below.focus_chain for point in _points(widget)]
        self._points = dict(zip(LETTERS, points, strict=False))

    def compose(self) -> ComposeResult:
        for letter, (offset, _) in self._points.items():
            label = Label(letter)
            label.styles.offset = offset
            yield label

    def on_key(self, event: events.Key) -> None:
        event.stop()
        if event.key == "space":
            return  # the stop key's own
        self.dismiss()
        if event.key in self._points:
            self.app.call_later(self._points[event.key][1])


def _go_to(widget: Widget) -> None:
    widget.focus()


def _points(widget: Widget) -> Iterable[tuple[Offset, Callable[[], None]]]:
    if not widget.region.area:
        return
    if isinstance(widget, JumpPoints):
        yield from widget.jump_points()
    else:
        yield widget.region.offset, partial(_go_to, widget)
