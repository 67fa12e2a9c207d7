"""The tour of the terminal program: its pictures and the page that shows them, made by walking it.

    python -m openant_tools.tui.tour docs        (or: make tour)

Each picture is the program itself on a virtual robot, so that the page says what the program does; and so is the film of
the whole walk, from `openant` in an empty folder to an agent that walks, with nothing but keys.
"""

from __future__ import annotations

import asyncio
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path

from textual.pilot import Pilot
from textual.widgets import Input

from openant_tools.bringup.walk import WALK
from openant_tools.errors import HardwareFault
from openant_tools.files import write_text
from openant_tools.robot.folder import create_robot
from openant_tools.tui.app import OpenAnt
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.feeds import ReplayFeed
from openant_tools.tui.film import Film
from openant_tools.tui.leg_map import REST_S
from openant_tools.tui.screens.step import STOP, StepScreen

__all__ = ["PAGES", "make"]

PATIENCE_S = 120.0
#: s for the longest step, and for the training, on a busy machine
LONG_S = 3600.0
#: s in which a viewer sees what a key answers
READ_S = 0.7
#: what differs where the same is asked of another joint
_SAME = re.compile(r"\d|\b(front|rear|left|right|hip|knee)\b|(hip|knee)_\w\w|counter-|clockwise.*|up:.*")

#: picture → heading and words of the page
PAGES: dict[str, tuple[str, str]] = {
    "walk": (
        "The walk",
        "`openant` without a command opens the first screen: the steps from loose motors to a robot that learns, each "
        "with its state, what the chosen one does, and the robot from above. `v` starts a virtual robot where there is "
        "no real one. **Space is the stop key, on every screen.**",
    ),
    "grant": (
        "It asks before it does",
        "A step says what it will do and which registers it will change. Nothing is written and nothing moves before "
        "you say yes; every write to a servo's memory goes into `journal.jsonl` with the value before, and *Undo* takes "
        "it back.",
    ),
    "found": (
        "What a step leaves behind",
        "A finding: one sentence, the numbers that it rests on with their units and sources, and the next step. It is "
        "kept in the robot's `findings/`; a step can be left, resumed and repeated.",
    ),
    "mistake": (
        "When something is plugged wrong",
        "Two factory-fresh motors share one id. The program sees it before it writes to both, and says which cable to pull.",
    ),
    "live": (
        "Live, and replayed",
        "All joints ten times a second: state, value, the last ten seconds, supply, heat. Here a recording plays: "
        "every screen shows it as if its robot were here. Arrows choose another signal and another joint.",
    ),
    "jump": (
        "Jump",
        "`Ctrl-O` puts a letter on everything that can be gone to; `Ctrl-P` finds any command by name; `F1` explains what "
        "has the focus.",
    ),
}  # fmt: skip

HEAD = """\
# A tour of the terminal program

Made by `make tour`, which walks the program with a virtual robot and takes these pictures; do not edit it by hand.

```sh
openant                        # in a terminal of 80 by 24 or more
openant --serve                # the same in a browser (pip install 'openant-tools[serve]')
OPENANT_ASCII=1 NO_COLOR=1 openant   # for terminals with neither Unicode nor colours
```
"""

FILM = """\
## The whole of it

`openant` in an empty folder, at 80 by 24, with a virtual robot in loose parts: every key that is pressed is shown below the screen.
Waiting is cut, what takes long plays as the root of its time, what is done for the third time faster.

![The walk, from loose motors, in the program's own frames](pictures/tour-film.svg)
"""

TAIL = """\
## Reference

### Keys

| key | |
|---|---|
| `space` | **stop**: torque off, at any time, on every screen |
| arrows, `Tab`, `Enter` | move, choose |
| `Esc` | back; on the first screen: quit |
| `F1`, `Ctrl-P`, `Ctrl-O` | help, all commands, jump |
| `F8` | a fault has been seen; it stays on every screen until then, even if it is over |
| `p` `,` `.` `[` `]` `<` `>` `x` | replay: pause, step, 5 s, speed, end |

In tmux an `Esc` waits for half a second for what may follow it; `set -sg escape-time 10` in `~/.tmux.conf` ends that.

A state is a glyph, a word and a colour at once: `✓` ok, `✗` no, `▲` look, `…` running, `↻` again, `·` to do.
"""


def make(docs: Path) -> None:
    """Walk, take the pictures into `docs/pictures/` as tour-NAME.svg, and write `docs/tour.md`.

    Raises:
        HardwareFault: the virtual robot did not do what the tour shows.
    """
    docs = docs.resolve()
    pictures = docs / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)

    def take(app: OpenAnt, name: str) -> None:
        # Their ids are random, and would make every picture new.
        write_text(pictures / f"tour-{name}.svg", _settled(app.export_screenshot(title="openant")))

    os.environ["TEXTUAL_ANIMATIONS"] = "none"
    with tempfile.TemporaryDirectory(prefix="openant-tour-") as folder:
        here = os.getcwd()
        recording = _record(Path(folder))
        os.chdir(folder)
        try:
            asyncio.run(_walk(take))
            asyncio.run(_replay(take, recording))
            place = Path(folder) / "film"
            place.mkdir()
            film = asyncio.run(film_walk(place))
        finally:
            os.chdir(here)
    write_text(pictures / "tour-film.svg", film.svg("The walk, from loose motors, in the program's own frames"))
    parts = [HEAD, FILM]
    for name, (title, words) in PAGES.items():
        parts.append(f"## {title}\n\n{words}\n\n![{title}](pictures/tour-{name}.svg)\n")
    write_text(docs / "tour.md", "\n".join([*parts, TAIL]))


def _record(folder: Path) -> Path:
    out = folder / "walk.mcap"
    command = ("sysid", "record", "--virtual", "--protocol", "stand", "--seconds", "12", "--out", str(out), "--yes")
    subprocess.run([sys.executable, "-m", "openant_tools.cli", *command], check=True, capture_output=True)
    return out


async def _walk(take: Callable[[OpenAnt, str], None]) -> None:
    """Connect, the stop key, and the first two motors, one of them with a mistake."""
    app = OpenAnt(create_robot(Path("my-ant")).path, clock="stepped")
    try:
        async with app.run_test(size=(80, 24)) as pilot:
            app.start_virtual(None)
            await _until(pilot, lambda: app.session.virtual is not None and not app.session.doing)
            app.open_step("connect")
            await _choose(pilot, "Begin")
            await _choose(pilot, "Next: Emergency stop")
            await _choose(pilot, "Begin")
            await _choose(pilot, "Let the virtual")
            await _choose(pilot, "Yes")
            await _until(pilot, lambda: "stop" in _offered(pilot))
            await pilot.press("space")
            await _until(pilot, lambda: "Next: Motor IDs" in _offered(pilot))
            await pilot.pause(0.2)
            take(app, "found")
            await pilot.press("escape")
            await pilot.pause(0.2)
            await pilot.press("down")
            await pilot.pause(0.2)
            take(app, "walk")
            await pilot.press("ctrl+o")
            await pilot.pause(0.2)
            take(app, "jump")
            await pilot.press("escape")
            app.open_step("ids")
            await _choose(pilot, "Begin")
            await _choose(pilot, "Let the virtual")
            if "Yes, do it" not in _offered(pilot):
                # The servo of the step before was still plugged in.
                await _choose(pilot, "Let the virtual")
            await _until(pilot, lambda: "Yes, do it" in _offered(pilot))
            await pilot.pause(0.2)
            take(app, "grant")
            await _choose(pilot, "Yes")
            await _choose(pilot, "Let the virtual")
            await _until(pilot, lambda: "Let the virtual robot's hands do it" in _offered(pilot))
            _plug(app, "knee_rr", "hip_fr")
            await _choose(pilot, "It is done already")
            await _until(pilot, lambda: "try again" in _offered(pilot))
            await pilot.pause(0.2)
            take(app, "mistake")
            await pilot.press("space")
            await _until(pilot, lambda: any(line.startswith("Begin again") for line in _offered(pilot)))
    finally:
        app.session.close()


async def film_walk(folder: Path) -> Film:
    """The walk as a new user goes it: `openant` in an empty folder, a virtual robot in loose parts, every step, an agent.

    Raises:
        HardwareFault: it does not go on, or the agent does not learn.
    """
    os.chdir(folder)
    app = OpenAnt(Path(), clock="stepped")
    film = Film(app)
    try:
        async with app.run_test(size=(80, 24)) as pilot:

            async def press(*keys: str, again: bool = False) -> None:
                for key in keys:
                    await pilot.pause(READ_S)
                    film.press(key, again)
                    await pilot.press(key)
                await pilot.pause()

            film.roll()
            await press("v", "enter", "enter")  # a virtual robot; its folder; loose motors in their box
            await _until(pilot, lambda: app.session.virtual is not None and not app.session.doing)
            await press("1", "enter")
            await _go_through(pilot, app, press)
            await press("escape", "t")  # the screen on which agents learn
            await press("tab", "tab", "enter")  # a first look
            await _until(pilot, lambda: app.session.learning, LONG_S)
            await _until(pilot, lambda: not app.session.learning, LONG_S)
            await pilot.pause(2.0)
            film.end()
    finally:
        app.session.close()
    return film


async def _go_through(pilot: Pilot[int], app: OpenAnt, press: Callable[..., Awaitable[None]]) -> None:
    """Every step to the last: what is offered first is chosen; the virtual robot's hands do what hands do."""
    names = list(WALK)
    met = Counter[str]()
    while True:
        await _until(pilot, lambda: isinstance(app.screen, Question) or bool(_offered(pilot)) or _asked(pilot), LONG_S)
        screen = app.screen
        # What is asked of one joint after the other has been seen after the second.
        words = _SAME.sub("", screen.verdict.plain) if isinstance(screen, StepScreen) else ""
        met[words] += 1
        again = met[words] > 2
        if not isinstance(screen, StepScreen):
            await press("enter")
        elif STOP in _offered(pilot):
            await press("space")
        elif screen.step.name == names[-1] and not screen.running and screen.found is not None:
            return
        else:
            wanted = ("Let the virtual", "Next: ", "Yes, and all further")
            at = next((k for words in wanted for k, line in enumerate(_offered(pilot)) if line.startswith(words)), None)
            chooser = screen.query_one("#choices", Choices)
            while at is not None and chooser.highlighted is not None and chooser.highlighted != at:
                await press("down" if chooser.highlighted < at else "up", again=again)
            await press("enter", again=again)


def _asked(pilot: Pilot[int]) -> bool:
    """Whether a number is asked for."""
    return isinstance(pilot.app.focused, Input) and isinstance(pilot.app.screen, StepScreen)


async def _replay(take: Callable[[OpenAnt, str], None], recording: Path) -> None:
    from openant_tools.recording.tables import read_run

    app = OpenAnt(Path("my-ant"), ticking=False)
    async with app.run_test(size=(120, 34)) as pilot:
        feed = ReplayFeed(read_run(recording), clock=lambda: 0.0)
        feed.playing = False
        app.play(feed)
        feed.seek(10.0)
        app.session.selected = "knee_fl"
        app.tick()
        await pilot.pause(2 * REST_S)
        take(app, "live")


def _plug(app: OpenAnt, *joints: str) -> None:
    """What a builder does who has three hands."""
    from openant_tools.comms.clock import VirtualControl

    assert app.session.virtual is not None
    control = VirtualControl(str(app.session.virtual["control"]))
    for joint in joints:
        control.ask("plug", joint=joint)
    control.close()


def _offered(pilot: Pilot[int]) -> list[str]:
    screen = pilot.app.screen
    return [choice.words for choice in screen.choices] if isinstance(screen, StepScreen) else []


async def _choose(pilot: Pilot[int], words: str) -> None:
    await _until(pilot, lambda: any(line.startswith(words) for line in _offered(pilot)))
    at = next(k for k, line in enumerate(_offered(pilot)) if line.startswith(words))
    pilot.app.screen.query_one("#choices", Choices).highlighted = at
    await pilot.press("enter")
    await pilot.pause()


async def _until(pilot: Pilot[int], what: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
    give_up = time.monotonic() + patience_s
    while not what():
        if time.monotonic() > give_up:
            raise HardwareFault(f"the tour stands still where it offers {_offered(pilot)}", remedy="walk it by hand")
        await pilot.pause(0.05)


def _settled(svg: str) -> str:
    return re.sub(r"terminal-\d+", "terminal", svg)


if __name__ == "__main__":
    make(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
