"""A film of the terminal program: its own frames as they change, as one animated SVG that needs no script.

    film = Film(app)              # takes a frame whenever its timer finds another screen
    film.press("enter")           # is shown below the screen; again=True plays what follows faster
    film.end()
    write_text(path, film.svg())

Nothing is drawn for the film: a frame is what the compositor gives the terminal. What takes long plays as the root of its
time, what does not change is cut to a second, what is done for the third time plays faster, and so does all of it where it
would last longer than `LONGEST_S`; a film that would be larger than `MOST_BYTES` shows fewer frames. Where motion is unwanted
(`prefers-reduced-motion`) the last frame stands still.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from html import escape

from rich.cells import cell_len
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from textual.app import App
from textual.timer import Timer

__all__ = ["Film"]

#: s between two looks at the screen, and at least between two frames of the film
LOOK_S = 0.2
FRAME_S = 0.2
#: s that nothing happens in the film, at most; and the film
STILL_S = 1.0
LONGEST_S = 170.0
#: of its time that is left to what is shown again
AGAIN = 0.3
#: of the file
MOST_BYTES = 3_000_000
#: s for which the last frame stays
END_S = 4.0
#: of a cell, in the SVG's own units
WIDTH, HEIGHT, FONT = 8.4, 18, 14
MARGIN = 8
INK, PAPER = ColorTriplet(230, 230, 230), ColorTriplet(16, 21, 27)
SHOWN = {"enter": "⏎ Enter", "space": "␣ Space", "escape": "Esc", "up": "↑", "down": "↓", "tab": "⇥ Tab"}

#: of a row: the text of each run of cells, and its look
Row = tuple[tuple[str, "Look"], ...]


@dataclass(frozen=True)
class Look:
    """How cells look: colours as #rrggbb, None for the paper's."""

    ink: str
    paper: str | None
    bold: bool
    faint: bool
    underline: bool

    @staticmethod
    @cache
    def of(style: Style | None) -> Look:
        """The look of a segment's style."""
        style = style or Style()
        ink = style.color.get_truecolor() if style.color and not style.color.is_default else INK
        paper = style.bgcolor.get_truecolor() if style.bgcolor and not style.bgcolor.is_default else PAPER
        if style.reverse:
            ink, paper = paper, ink
        return Look(
            ink.hex, None if paper == PAPER else paper.hex, bool(style.bold), bool(style.dim), bool(style.underline)
        )


@dataclass
class Film:
    """What an app showed.

    Attributes:
        app: whose frames are taken while it runs.
        clock: s, monotonic.
        frames: (s, its rows) of each frame that differs from the one before, the last row being the key pressed.
        keys: s of each key → whether it does once more what was shown before.
    """

    app: App[int]
    clock: Callable[[], float] = time.monotonic
    frames: list[tuple[float, tuple[Row, ...]]] = field(default_factory=list)
    keys: dict[float, bool] = field(default_factory=dict)
    _timer: Timer | None = None
    _pressed: str = ""
    _pressed_at: float = -math.inf

    def roll(self) -> None:
        """Look at the screen from now on, until the end."""
        self._timer = self.app.set_interval(LOOK_S, self.look)

    def end(self) -> None:
        """The last look: how a program takes its screens down is not shown."""
        self.look()
        if self._timer is not None:
            self._timer.stop()

    def press(self, key: str, again: bool = False) -> None:
        """A key is pressed now; `again` where what it does was shown before."""
        self._pressed, self._pressed_at = SHOWN.get(key, key), self.clock()
        self.keys[self._pressed_at] = again
        self.look()

    def look(self) -> None:
        """Keep the screen as it is now, if it differs from the last."""
        app = self.app
        if not app.screen_stack or not app.screen.size:
            return
        update = app.screen._compositor.render_update(full=True, screen_stack=app._background_screens)
        strips = getattr(update, "strips", ())
        if len(strips) != app.size.height or any(strip is None for line in strips for strip in line):
            return  # between two screens, or nothing is drawn in a place yet
        rows = [_row(segment for strip in line for segment in strip) for line in strips]
        now = self.clock()
        pressed = self._pressed if now - self._pressed_at < STILL_S else ""
        rows.append(((f"  {pressed}", Look("#f0e442", None, True, False, False)),) if pressed else ())
        if not self.frames or self.frames[-1][1] != tuple(rows):
            self.frames.append((now, tuple(rows)))

    def cut(self, frame_s: float = FRAME_S) -> list[tuple[float, tuple[Row, ...]]]:
        """The frames at the times at which the film shows them, s, none sooner than `frame_s` after the one before."""
        begins = self.frames[0][0]
        cuts = sorted({begins, *(key for key in self.keys if key > begins), math.inf})
        timed: list[tuple[float, tuple[Row, ...]]] = []
        at = 0.0
        for begin, end in itertools.pairwise(cuts):
            scene = [frame for frame in self.frames if begin <= frame[0] < end]
            if not scene:
                continue
            again = AGAIN if self.keys.get(begin, False) else 1.0
            last = min(end, scene[-1][0] + STILL_S)
            # what takes long plays as the root of its time
            pace = again * min(1.0, 1.0 / math.sqrt(max(1.0, last - begin)))
            played, before = at, begin
            for moment, rows in scene:
                played += min(again * STILL_S, (moment - before) * pace)
                before = moment
                timed.append((played, rows))
            at = played + min(again * STILL_S, (last - before) * pace if end < math.inf else STILL_S)
        faster = min(1.0, (LONGEST_S - END_S) / max(at, 1e-9))
        shown: list[tuple[float, tuple[Row, ...]]] = []
        for moment, rows in timed:
            if shown and faster * moment - shown[-1][0] < frame_s:  # what is seen is never older than it must be
                shown[-1] = (shown[-1][0], rows)
            else:
                shown.append((faster * moment, rows))
        return shown

    def svg(self, title: str = "The terminal program, walked") -> str:
        """The film as an SVG of at most `MOST_BYTES`; what is too much for that is left out, frame by frame."""
        frame_s = FRAME_S
        while len((drawn := self._svg(self.cut(frame_s), title)).encode()) > MOST_BYTES and frame_s < STILL_S:
            frame_s *= 1.25
        return drawn

    def _svg(self, frames: list[tuple[float, tuple[Row, ...]]], title: str) -> str:
        """One strip of pictures for each row of the screen, of which each moment shows one."""
        lasts = frames[-1][0] + END_S
        columns = max(sum(cell_len(text) for text, _ in row) for _, rows in frames for row in rows)
        width, height = round(columns * WIDTH + 2 * MARGIN), len(frames[0][1]) * HEIGHT + 2 * MARGIN
        looks: dict[Look, int] = {}
        drawn: dict[Row, int] = {}
        strips, motions = [], []
        for line in range(len(frames[0][1])):
            places: dict[Row, int] = {}
            steps: list[tuple[float, int]] = []
            for moment, rows in frames:
                place = places.setdefault(rows[line], len(places))
                drawn.setdefault(rows[line], len(drawn))
                if not steps or steps[-1][1] != place:
                    steps.append((moment, place))
            pictures = "".join(
                f'<use href="#r{drawn[row]}" x="{place * width}"/>' for row, place in places.items() if row
            )
            moving = f' class="m" style="animation-name:l{line}"' if len(places) > 1 else ""
            # Where nothing may move, the place of the last frame.
            still = f' transform="translate({-steps[-1][1] * width})"' if steps[-1][1] else ""
            strips.append(
                f'<g transform="translate({MARGIN} {MARGIN + line * HEIGHT})"><g{moving}{still}>{pictures}</g></g>'
            )
            if moving:
                stops = "".join(
                    f"{_plain(100 * moment / lasts, 3)}%{{transform:translateX({-place * width}px)}}"
                    for moment, place in steps
                )
                motions.append(f"@keyframes l{line}{{{stops}100%{{transform:translateX({-steps[-1][1] * width}px)}}}}")
        rows_drawn = "".join(f'<g id="r{number}">{_drawn(row, looks)}</g>' for row, number in drawn.items() if row)
        classes = "".join(
            f".k{number}{{fill:{look.ink}{';font-weight:700' if look.bold else ''}{';opacity:.6' if look.faint else ''}"
            f"{';text-decoration:underline' if look.underline else ''}}}"
            for look, number in looks.items()
        )
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" xml:space="preserve" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
            f'aria-label="{escape(title)}"><title>{escape(title)}</title><style>'
            f"text{{font:{FONT}px 'DejaVu Sans Mono',Menlo,Consolas,monospace;white-space:pre}}{classes}"
            f"@media (prefers-reduced-motion:no-preference){{.m{{animation:{_plain(lasts)}s step-end infinite}}}}"
            f"{''.join(motions)}</style><defs>{rows_drawn}</defs>"
            f'<rect width="100%" height="100%" rx="8" fill="{PAPER.hex}"/>{"".join(strips)}</svg>\n'
        )


def _row(segments: Iterable[Segment]) -> Row:
    """Cells that look alike, together; what is blank at the end is left out."""
    found: list[tuple[str, Look]] = []
    for segment in segments:
        if segment.control:
            continue
        look = Look.of(segment.style)
        if found and found[-1][1] == look:
            found[-1] = (found[-1][0] + segment.text, look)
        else:
            found.append((segment.text, look))
    while found and not found[-1][0].strip() and found[-1][1].paper is None:
        found.pop()
    return tuple(found)


def _drawn(row: Row, looks: dict[Look, int]) -> str:
    out, column = [], 0
    for text, look in row:
        cells = cell_len(text)
        x, wide = column * WIDTH, cells * WIDTH
        column += cells
        if look.paper is not None:
            out.append(f'<rect x="{_plain(x)}" width="{_plain(wide)}" height="{HEIGHT}" fill="{look.paper}"/>')
        if text.strip():
            before = len(text) - len(text.lstrip())
            words = text.strip()
            number = looks.setdefault(look, len(looks))
            out.append(
                f'<text class="k{number}" x="{_plain(x + before * WIDTH)}" y="{FONT}" textLength="{_plain(cell_len(words) * WIDTH)}" '
                f'lengthAdjust="spacingAndGlyphs">{escape(words, quote=False)}</text>'
            )
    return "".join(out)


def _plain(value: float, decimals: int = 1) -> str:
    return f"{value:.{decimals}f}"  # for a file
