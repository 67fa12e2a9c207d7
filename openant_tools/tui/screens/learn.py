"""Learn: start a training run in a process of its own, watch its curve, stop it, let it go on."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.widgets import Input, Label, OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.numbers import number, percent, span
from openant_tools.tui.braille import trace
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.marks import BLUE, marked, plain, spelled
from openant_tools.tui.page import Page
from openant_tools.tui.training import AGENTS, Training, read_curve

__all__ = ["LearnScreen"]

REFRESH_S = 1.0
ON_ROBOT = " robot"
#: the paper's list for the start of an experiment
BEFORE = (
    "The robot moves, for as long as it trains. Is it on the floor, inside the circle, facing its reward, its cables outside "
    "the circle and untangled?"
)
_WORDS = {"sac": "soft actor-critic, as in the paper", "sarsa": "SARSA(lambda) with tile coding, as in the paper"}


class LearnScreen(Page):
    """What to train above, how it goes below."""

    TITLE = "Learn"
    HELP = """\
# Learn

Choose an agent and where it trains: in the simulation of this robot, or on the robot itself, on its floor under the camera
(on a virtual robot where one is in use: one of its own, in stepped time). It is a process of its own, with the command that
stands on the screen. You may leave this screen meanwhile. Stopping saves; the same choice goes on from there. `Space` stops
training on the robot, too, with torque off.

The curve is the average reward over the last 120 s of robot time, in cm/s: how fast it walks where it should.
"""

    def body(self) -> ComposeResult:
        with Vertical(id="form"):
            with Horizontal(classes="line"):
                yield Label("steps")
                yield Input("30000", type="integer", id="steps")
                yield Label("of 0.12 s; 30000 are an hour of robot time", classes="after")
            with Horizontal(classes="line"):
                yield Label("seed")
                yield Input("0", type="integer", id="seed")
                yield Label("what chance begins with; each has a run of its own", classes="after")
            yield Choices(
                *(Option(f"Train {name} in simulation: {_WORDS[name]}", id=name) for name in AGENTS),
                *(Option(f"Train {name} on the robot: it moves", id=f"{name}{ON_ROBOT}") for name in AGENTS),
                Option("Stop and save", id="stop"),
                id="choices",
            )
        yield Static(id="progress")

    def on_mount(self) -> None:
        super().on_mount()
        self.set_interval(REFRESH_S, self.draw_progress)
        chooser = self.query_one("#choices", Choices)
        chooser.highlighted = 0
        chooser.focus()
        self.draw_progress()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.query_one("#choices").focus()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        if event.option_id == "stop":
            if self.session.training is not None:
                self.session.training.stop()
        elif event.option_id is not None and event.option_id.endswith(ON_ROBOT):
            self._ask_robot(event.option_id.removesuffix(ON_ROBOT))
        elif event.option_id is not None:
            self.start(event.option_id)
        self.draw_progress()

    def _ask_robot(self, agent: str) -> None:
        """What moves the robot asks first; the bus has one master, so who watches gives it free."""
        if self.session.virtual is not None:
            self.start(agent, "virtual")
            return

        def answered(choice: int | None) -> None:
            if choice == 0:
                self.ant.free_bus(lambda: self.start(agent, "robot"))

        self.app.push_screen(Question(BEFORE, "Yes, train", "No"), answered)

    def start(self, agent: str, where: Literal["sim", "robot", "virtual"] = "sim") -> None:
        """Train, or go on with the run of the same agent, place and seed."""
        folder = self.session.folder
        progress = self.query_one("#progress", Static)
        if folder is None:
            progress.update(marked("fail", "there is no robot's folder: make one in Settings (s on the first screen)"))
            return
        if self.session.learning:
            progress.update(marked("warn", "one run is enough at a time: stop it first"))
            return
        steps, seed = (self.query_one(f"#{name}", Input).value for name in ("steps", "seed"))
        if not steps.isdigit() or int(steps) < 1 or not seed.isdigit():
            progress.update(marked("fail", "steps and seed are whole numbers"))
            return
        out = folder.runs / (f"{agent}-{seed}" if where == "sim" else f"{agent}-{where}-{seed}")
        training = Training(agent, folder.path, int(steps), int(seed), out, where)
        training.start()
        self.session.training = training
        self.draw_progress()

    def draw_progress(self) -> None:
        """From the files of the run."""
        training, folder = self.session.training, self.session.folder
        text = Text()
        if training is not None:
            if training.running:
                text.append_text(marked("wait", "training"))
            else:
                code = training.exit_code
                text.append_text(
                    marked("ok", "done") if code == 0 else marked("warn", "stopped, saved") if code == 130
                    else marked("fail", training.last_words)
                )  # fmt: skip
            text.append(f"   {training.command}\n")
            self._curve(text, training.folder, training.steps)
        elif folder is not None:
            for run in sorted(folder.runs.glob("*/learning_curve.csv")):
                text.append(f"{run.parent.name}\n", "bold")
                self._curve(text, run.parent, None)
        if not text:
            text.append("No run yet.")
        self.query_one("#progress", Static).update(text)

    def _curve(self, text: Text, run: Path, steps: int | None) -> None:
        points = read_curve(run)
        if not points:
            text.append("  no point of the curve yet\n")
            return
        step = np.array([point.step for point in points], float)
        reward = 100 * np.array([point.average_reward_m_s for point in points])
        width = max(20, self.size.width - 4)
        share = "" if steps is None else f" of {steps} ({percent(step[-1] / steps)})"
        text.append(
            f"  step {number(step[-1])}{share}, {number(points[-1].seconds / 60, decimals=0)} min of robot time: "
            f"{spelled(number(reward[-1], sign=True, decimals=1))} cm/s\n"
        )
        low, high = min(0.0, float(reward.min())), max(1.0, float(reward.max()))
        stop = max(float(step[-1]), float(steps or 0.0))
        lines = trace(step, reward, 0.0, stop, low, high, width, 4, plain=plain())
        for line in lines:
            text.append(f"  {line}\n", BLUE)
        text.append(f"  {spelled(span(low, high))} cm/s over {span(0.0, stop)} steps\n")
