"""The film of the terminal program: its own frames, waiting cut, a still where nothing may move."""

from __future__ import annotations

import asyncio
import re
from itertools import pairwise
from xml.etree import ElementTree

import pytest
from textual.app import App, ComposeResult
from textual.widgets import Static

from openant_tools.tui import film
from openant_tools.tui.film import AGAIN, END_S, LONGEST_S, STILL_S, Film


class Counter(App[int]):
    """Shows how often `a` was pressed, on two lines that never change."""

    BINDINGS = [("a", "more", "More")]  # noqa: RUF012
    pressed = 0

    def compose(self) -> ComposeResult:
        yield Static("[bold]always[/] the same & <this>")
        yield Static("0", id="count")

    def action_more(self) -> None:
        self.pressed += 1
        self.query_one("#count", Static).update(f"[reverse]{self.pressed}[/] times")


class Clock:
    """Stands still until it is set."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def filmed(pauses: list[float], *, again: bool = False) -> Film:
    async def run() -> Film:
        app, clock = Counter(), Clock()
        film = Film(app, clock)
        async with app.run_test(size=(40, 4)) as pilot:
            film.look()
            for pause in pauses:
                clock.now += pause
                film.press("a", again)
                await pilot.press("a")
                await pilot.pause()
                clock.now += 0.5
                film.look()
        return film

    return asyncio.run(run())


def test_a_film_shows_each_frame_and_moves_only_the_rows_that_change() -> None:
    svg = filmed([1.0, 1.0, 1.0]).svg("Counting")
    root = ElementTree.fromstring(svg)
    assert root.get("aria-label") == "Counting"
    said = "".join(root.itertext())
    for words in ("always", "1", "3", "times", "& <this>"):
        assert words in said
    # The row of the count and the row of the key; nothing else has anything to show at another time.
    assert len(re.findall(r"@keyframes", svg)) == 2
    assert "prefers-reduced-motion:no-preference" in svg
    assert "<script" not in svg


def test_waiting_is_cut_and_the_whole_is_never_long(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = filmed([600.0, 1.0]).cut()
    assert frames[-1][0] < 8 * STILL_S
    assert [moment for moment, _ in frames] == sorted(moment for moment, _ in frames)
    # Each press of a key takes Textual's pilot a tenth of a second of waiting: a film of fewer, and less is long.
    whole, longest = filmed([30.0] * 40), 10 * END_S
    assert longest < whole.cut()[-1][0] < LONGEST_S - END_S
    monkeypatch.setattr(film, "LONGEST_S", longest)
    assert whole.cut()[-1][0] <= longest - END_S


def test_what_was_shown_before_plays_faster() -> None:
    first, again = (filmed([1.0] * 6, again=again).cut() for again in (False, True))
    assert again[-1][0] - again[0][0] < 1.5 * AGAIN * (first[-1][0] - first[0][0])


def test_a_film_is_never_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = filmed([0.3] * 30)
    most = len(whole.svg().encode()) * 2 // 3
    monkeypatch.setattr(film, "MOST_BYTES", most)
    assert len(whole.svg().encode()) <= most
    sooner, later = whole.cut(), whole.cut(1.0)
    assert len(later) < len(sooner)
    assert all(two - one >= 1.0 for (one, _), (two, _) in pairwise(later))
    assert later[-1][1] == sooner[-1][1]
