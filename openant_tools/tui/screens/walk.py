"""The first screen: the steps of the walk and how far this robot got."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.bringup.walk import WALK, Standing, standing
from openant_tools.numbers import number
from openant_tools.procedure.step import Step
from openant_tools.robot.folder import RobotFolder
from openant_tools.tui.choices import Choices
from openant_tools.tui.found import sign
from openant_tools.tui.leg_map import LegMap
from openant_tools.tui.marks import Name, mark, marked, plain, spelled
from openant_tools.tui.page import Page
from openant_tools.tui.step_help import step_doc, step_help

__all__ = ["WalkScreen", "continues", "standing_mark"]

_MARKS: dict[str, Name] = {"todo": "todo", "ok": "ok", "failed": "fail", "unsure": "unsure", "stale": "stale"}
CHECK, BENCH, VIRTUAL = "check", "bench", "virtual"


def standing_mark(one: Standing) -> Text:
    """A step's state; of one that was left in the middle how far it was."""
    if one.left is not None and one.state != "ok":
        return marked("warn", f"{one.left.words} done")
    if one.virtual:
        return marked("todo", "done, virtual")
    return marked(_MARKS[one.state])


def continues(folder: RobotFolder, *, real: bool = True) -> str:
    """How far a robot's walk is, and what is next: `Continue my-ant · 3 of 15 · next: Motor IDs`.

    Args:
        real: whether what was found on a virtual robot counts for nothing.
    """
    states = standing(folder, real=real)
    done = sum(one.state == "ok" for one in states.values())
    following = next((one for one in states.values() if one.state != "ok"), None)
    words = f"Continue {folder.path.resolve().name} · {done} of {len(states)}"
    if following is None:
        return f"{words} · all done"
    at = "" if following.left is None else f", at {len(following.left.done) + 1} of {len(following.left.of)}"
    return f"{words} · next: {following.step.title}{at}"


class WalkList(Choices):
    """The steps."""

    HELP = """\
# The walk

The steps from loose motors to a robot that learns, in the order in which one builds. `Enter` opens one; it says what it
will do before it does anything. You can leave a step, come back, repeat it, and undo what it wrote.

| mark | |
|---|---|
| `·` to do | not done yet |
| `✓` ok | done, with evidence in the robot's `findings/` |
| `✗` no | it found something: open it and read what to do |
| `?` doubt | it cannot judge: open it and read why |
| `↻` again | a step that it builds on was done again since |
| `·` done, virtual | done on a virtual robot only: counts while one is in use, not for the real robot |

No robot here? The line below the steps starts a virtual one, which behaves like a real one down to its bytes.
"""


class WalkScreen(Page):
    """Steps on the left, what the chosen one does and the robot on the right."""

    TITLE = "Walk"
    DOC = "bring-up.md"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("v", "app.virtual", "Virtual"),
        Binding("c", "app.watch", "Live"),
        Binding("k", "app.step('check')", "Check", show=False),
        Binding("b", "app.bench", "Bench", show=False),
        Binding("u", "app.step('undo')", "Undo", show=False),
        Binding("f", "app.go('findings')", "Findings"),
        Binding("r", "app.go('recordings')", "Replay"),
        Binding("g", "app.go('gap')", "Gap"),
        Binding("t", "app.go('learn')", "Learn"),
        Binding("s", "app.go('settings')", "Setup"),
        Binding("escape,q", "app.leave", "Quit", key_display="q"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._shown: Path | None = None
        self._standing: dict[str, Standing] = {}

    def body(self) -> ComposeResult:
        yield Static(id="continue")
        with Horizontal():
            yield WalkList(id="walk")
            with Vertical(id="beside"):
                yield Static(id="about")
                yield LegMap(self.session.history)

    def on_mount(self) -> None:
        self.refresh_steps()
        super().on_mount()
        self.query_one(WalkList).focus()

    def on_screen_resume(self) -> None:
        self.refresh_steps()
        super().on_screen_resume()

    def refresh_steps(self) -> None:
        """Read the robot's findings anew."""
        walk = self.query_one(WalkList)
        chosen, names = walk.highlighted, list(WALK)
        folder = self.session.folder
        real = self.session.virtual is None
        before, self._standing = self._standing, standing(folder, real=real) if folder is not None else {}
        words = "No robot yet: Enter on a step makes its folder" if folder is None else continues(folder, real=real)
        self.query_one("#continue", Static).update(Text(spelled(words), style="bold"))
        if folder is not None and folder.path != self._shown:
            chosen, self._shown = None, folder.path
        elif (
            chosen is not None
            and chosen < len(names)
            and _done(before, names[chosen]) < _done(self._standing, names[chosen])
        ):
            chosen = None  # from a step that was done the cursor goes on to the next
        walk.clear_options()
        for n, (name, step) in enumerate(WALK.items(), 1):
            state = standing_mark(self._standing[name]) if name in self._standing else marked("todo")
            walk.add_option(Option(Text.assemble(f"{n:2} {step.title:21} ", state), id=name))
        walk.add_option(Option(Text(" k Daily check", style="bold"), id=CHECK))
        walk.add_option(Option(Text(" b On the bench", style="bold"), id=BENCH))
        offer = "End the virtual robot" if self.session.virtual is not None else "Start a virtual robot"
        walk.add_option(Option(Text(f" v {offer}", style="bold"), id=VIRTUAL))
        first = next((k for k, name in enumerate(names) if not _done(self._standing, name)), 0)
        walk.highlighted = first if chosen is None else min(chosen, walk.option_count - 1)

    def go_to(self, name: str) -> None:
        """Put the cursor on a step."""
        self.query_one(WalkList).highlighted = list(WALK).index(name)

    @property
    def _chosen_step(self) -> Step | None:
        option = self.query_one(WalkList).highlighted_option
        return None if option is None or option.id is None else WALK.get(option.id)

    @property
    def about(self) -> str:
        return "" if self._chosen_step is None else step_help(self._chosen_step)

    @property
    def doc(self) -> str:
        return self.DOC if self._chosen_step is None else step_doc(self._chosen_step)

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        about = self.query_one("#about", Static)
        if event.option_id is None or event.option_id == VIRTUAL:
            about.update(_ABOUT_VIRTUAL)
        elif event.option_id == CHECK:
            about.update(_ABOUT_CHECK)
        elif event.option_id == BENCH:
            about.update(_ABOUT_BENCH)
        else:
            about.update(_about(WALK[event.option_id], self._standing.get(event.option_id)))

    def chosen(self, event: OptionList.OptionSelected) -> None:
        if event.option_id == VIRTUAL:
            self.ant.action_virtual()
        elif event.option_id == BENCH:
            self.ant.action_bench()
        elif event.option_id is not None:
            self.ant.open_step(event.option_id)


def _done(states: Mapping[str, Standing], name: str) -> bool:
    return name in states and states[name].state == "ok"


_ABOUT_CHECK = Text.assemble(
    ("Daily check", "bold"),
    "  about 2 min\nBefore each session: the joint and the likely part, where something is not as it was when the passport "
    "was written.",
)
_ABOUT_BENCH = Text.assemble(
    ("On the bench\n", "bold"),
    "What else can be measured, each by itself: the knees' torque table, a joint's stiffness with a kitchen scale, the floor's "
    "friction on a tilted plate.",
)
_ABOUT_VIRTUAL = Text.assemble(
    ("Virtual robot\n", "bold"),
    "Servos, flight controller and camera in software, behind real ports and protocols. Walk through all steps with it "
    "before your robot does, or learn without one.",
)


def _about(step: Step, one: Standing | None) -> Text:
    text = Text.assemble((f"{step.title}", "bold"), f"  about {number(step.minutes)} min\n{step.does}\n")
    if one is not None and one.left is not None:
        text.append(f"{mark('warn')} left at {one.left.words}; next: {one.left.next}\n", "bold")
    if one is not None and one.virtual:
        text.append(f"{mark('todo')} done on a virtual robot: it does not count for the real one\n", "bold")
    if one is not None and one.finding is not None:
        text.append(f"{mark(sign(one.finding))} {one.finding.what}\n", "bold")
    if one is not None and one.waits_for:
        text.append(f"{mark('warn')} do first: {', '.join(WALK[name].title for name in one.waits_for)}\n")
    if step.table:
        text.append(f"You need {step.table}.\n")
    moves = "the robot moves, after you say so" if step.moves else "nothing moves"
    text.append(f"Changes {step.changes or 'nothing'}; {moves}.")
    return text if not plain() else Text(spelled(text.plain))
