"""The gap: choose runs, have them diagnosed, read the verdict, write the improved model."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.errors import OpenAntError
from openant_tools.numbers import number, percent
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.marks import BLUE, GREEN, MARKS, ORANGE, Name, mark, marked, plain, spelled
from openant_tools.tui.page import Page
from openant_tools.tui.process import Process
from openant_tools.tui.screens.recordings import runs_of, when

if TYPE_CHECKING:
    from openant_tools.gap.diagnosis import Diagnosis, Found

__all__ = ["GapScreen"]

REFRESH_S = 1.0
#: columns of a bar
BAR = 12
#: places and candidates shown; the report has all
PLACES, CANDIDATES = 5, 5
#: where a floor comes from, in words
FLOORS = {
    "repeats": ", by how much repeats of the same commands differ",
    "sensors": ", by what the sensors can tell",
}
STAMP = "%Y%m%dT%H%M%SZ"
IMPROVED = "improved.xml"
NONE_YET = (
    "No diagnosis yet.\n\nChoose runs in the list on the left (Enter), a policy's or, better, several motions on the stand and "
    "on the floor, then press d. A diagnosis says where the simulation differs from the robot, which unmodelled "
    "effect causes it, and how far the gap closes once that effect is added. It takes "
    "a minute or two, and seconds where the same runs were diagnosed before."
)


class GapScreen(Page):
    """Diagnoses and runs on the left, the chosen verdict on the right."""

    TITLE = "Gap"
    DOC = "gap.md"
    HELP = """\
# The gap between the robot and its simulation

Above on the left stand the diagnoses so far, below them the robot's recordings. `Enter` on a recording chooses it (`a` all
of them), `d` diagnoses what is chosen: a process of its own with the command that stands on the screen; you may leave the
screen meanwhile, and what it simulated is kept where it is stopped (`k`).

A verdict names an effect, or says `none` (nothing beyond what robots of one build differ by), `ambiguous` (these runs cannot
tell its causes apart) or `unexplained` (the gap is real, and nothing known closes it). What is marked `✓` goes into the
improved model, which `w` writes beside the robot's own. The full report with pictures lies in the robot's `gap/`.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("a", "all", "All runs"),
        Binding("d", "diagnose", "Diagnose"),
        Binding("w", "write", "Write model"),
        Binding("k", "stop", "Stop it"),
    ]

    def body(self) -> ComposeResult:
        with Horizontal():
            with Vertical(id="sources"):
                yield Static("Diagnoses", classes="title")
                yield Choices(id="diagnoses")
                yield Static("Runs", classes="title")
                yield Choices(id="runs")
            with VerticalScroll(can_focus=True):
                yield Static(id="verdict")
        yield Static(id="process")

    def on_mount(self) -> None:
        super().on_mount()
        self._chosen: set[Path] = set()
        self._shown: Path | None = None
        self._was_running = self.session.computing
        self._names = runs_of(self.session.folder)
        self._runs = list(self._names)
        runs = self.query_one("#runs", Choices)
        for index, path in enumerate(self._runs):
            runs.add_option(Option(self._line(path), id=str(index)))
        self._list()
        (self.query_one("#diagnoses", Choices) if self._files else runs).focus()
        if self._runs:
            runs.highlighted = 0
        self.set_interval(REFRESH_S, self.draw_process)
        self.draw_process()

    def _line(self, path: Path) -> Text:
        name = f"[{'x' if path in self._chosen else ' '}] {self._names[path]}"
        return Text(name).append(f"\n    {when(path.stat().st_mtime)}", MARKS["todo"].colour)

    def _list(self) -> None:
        """Read which diagnoses there are."""
        folder = self.session.folder
        self._files = sorted(folder.diagnoses.glob("*.json"), reverse=True) if folder is not None else []
        chooser = self.query_one("#diagnoses", Choices)
        chooser.clear_options()
        for path in self._files:
            chooser.add_option(Option(_when(path)))
        if self._files:
            chooser.highlighted = 0
        else:
            self.query_one("#verdict", Static).update(spelled(NONE_YET))

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        if event.option_list.id == "diagnoses" and event.option_index < len(self._files):
            self._shown = self._files[event.option_index]
            self._show(self._shown)

    def chosen(self, event: OptionList.OptionSelected) -> None:
        if event.option_list.id == "runs":
            self._choose(self._chosen ^ {self._runs[event.option_index]})

    def _choose(self, chosen: set[Path]) -> None:
        self._chosen = chosen
        runs = self.query_one("#runs", Choices)
        for index, path in enumerate(self._runs):
            runs.replace_option_prompt_at_index(index, self._line(path))
        self.draw_process()

    def action_all(self) -> None:
        """Choose all runs, or none where all are."""
        self._choose(set() if len(self._chosen) == len(self._runs) else set(self._runs))

    def on_resize(self) -> None:
        super().on_resize()
        if self._shown is not None:
            self._show(self._shown)

    def _show(self, path: Path) -> None:
        from openant_tools.gap.diagnosis import read_diagnosis  # all causes are loaded with it

        verdict = self.query_one("#verdict", Static)
        try:
            verdict.update(_page(read_diagnosis(path), _when(path)))
        except OpenAntError as error:
            verdict.update(marked("fail", str(error)))

    # ---- processes -----------------------------------------------------------------------------------------------

    def action_diagnose(self) -> None:
        """Diagnose the chosen runs."""
        folder = self.session.folder
        if folder is None or not self._chosen:
            self.notify("choose runs first: Enter on them", severity="warning")
            return
        self.diagnose([path for path in self._runs if path in self._chosen])

    def diagnose(self, runs: Sequence[Path]) -> None:
        """Diagnose these recordings."""
        folder = self.session.folder
        assert folder is not None
        out = folder.diagnoses / datetime.datetime.now(datetime.UTC).strftime(STAMP)
        names = map(str, runs)
        self._start(
            folder, "diagnose", *names, "--robot", str(folder.path), "--json", f"{out}.json", "--report", str(out)
        )

    def action_write(self) -> None:
        """Write the model without the gap, once the builder has said so."""
        folder, shown = self.session.folder, self._shown
        if folder is None or shown is None:
            self.notify("there is no diagnosis yet", severity="warning")
            return

        def answered(choice: int | None) -> None:
            if choice == 0:
                out = str(folder.path / IMPROVED)
                self._start(folder, "apply", str(shown), "--robot", str(folder.path), "--out", out)

        words = (
            f"Write what this diagnosis found into {IMPROVED}, and let robot.toml name it? The model as it is now stays where "
            "it is; the robot.toml before goes into backups/."
        )
        self.app.push_screen(Question(words, "Yes, write", "No"), answered)

    def action_stop(self) -> None:
        if self.session.diagnosing is not None:
            self.session.diagnosing.stop()

    def _start(self, folder: RobotFolder, *arguments: str) -> None:
        if self.session.computing:
            self.notify("one at a time: k stops what runs, and keeps what it simulated", severity="warning")
            return
        self.session.diagnosing = Process(("gap", *arguments), folder.diagnoses / "gap.log")
        self.session.diagnosing.start()
        self.draw_process()

    def draw_process(self) -> None:
        """What runs, and how far it is."""
        process = self.session.diagnosing
        text = Text(f"{len(self._chosen)} of {len(self._runs)} runs chosen")
        if process is not None:
            if process.running:
                text = marked("wait", process.progress or "begun")
            elif process.exit_code == 0:
                text = marked("ok", "done")
            elif process.exit_code == 130:
                text = marked("warn", "stopped; what was simulated is kept")
            else:
                text = marked("fail", process.last_words)
            text.append(f"\n{process.command}", "dim" if not plain() else "")
        self.query_one("#process", Static).update(text)
        if self._was_running and not self.session.computing:
            self._list()
        self._was_running = self.session.computing


def _when(path: Path) -> str:
    try:
        return when(datetime.datetime.strptime(path.stem, STAMP).replace(tzinfo=datetime.UTC).timestamp())
    except ValueError:
        return path.stem


def _page(found: Diagnosis, when: str) -> Text:
    """The verdict in the order in which one asks: what, where, which, how far, what next."""
    from openant_tools.gap.regime import Regime
    from openant_tools.gap.words import SIGNALS, closed, closing, sentence, what_next

    text = Text.assemble((spelled(sentence(found)), "bold"), "\n")
    text.append("\nWhere\n", "bold")
    for place in found.where[:PLACES]:
        share = float(place["share"])
        text.append(f" {place['joint']:8.8} ").append_text(_bar(share, ORANGE)).append(f" {percent(share):>5}\n")
        text.append(f"   {SIGNALS[place['signal']]} while {Regime(place['regime']).words}\n")
    text.append_text(_by_leg(found))
    text.append("\nWhich, and how likely\n", "bold")
    for one in found.effects[:CANDIDATES]:
        text.append_text(_candidate(found, one))
    gap, share = found.gap, closed(found)
    text.append("\nHow far\n", "bold")
    before, after, floor = (number(float(gap[name]), "rad", name="gap") for name in ("before", "after", "floor"))
    text.append(f" {before} {spelled('→')} {after} of position\n closed ")
    text.append_text(_bar(share, GREEN)).append(f" {closing(share):>5} on runs left out\n")
    source = FLOORS.get(str(found.gap.get("floor_from")), "")
    text.append(f" floor {floor}: what no model could beat{source}\n")
    text.append(f" compared: {Path(found.model).name} with {', '.join(found.held_out or found.runs)}, {when}\n")
    text.append("\nNext\n", "bold")
    text.append(f" {spelled(what_next(found))}\n")
    for note in found.notes:
        text.append(f" {mark('info')} {spelled(note)}\n", "" if plain() else "dim")
    return text


def _candidate(found: Diagnosis, one: Found) -> Text:
    from openant_tools.gap.words import BY_ITSELF, closing, sizes, standing, where_words

    unsure = any(one.effect in group for group in found.ambiguous_with)
    state: Name = "ok" if one.effect in found.selected else "warn" if unsure else "todo"
    text = Text.assemble(" ", marked(state, one.effect, 21))
    text.append_text(_bar(one.probability, BLUE)).append(f" {percent(one.probability):>5}\n")
    values = sizes(one, interval=False)
    why = standing(found, one)
    alone = "" if one.gap_closed is None or BY_ITSELF in why else f"{BY_ITSELF} {closing(one.gap_closed)}; "
    text.append(spelled(f"   {where_words(one.joints)}{': ' if values else ''}{values}\n   {alone}{why}\n"))
    return text


def _bar(share: float, colour: str) -> Text:
    full, empty = ("=", "-") if plain() else ("━", "─")
    done = min(max(round(share * BAR), 0), BAR)
    return Text.assemble((full * done, colour), empty * (BAR - done))


def _by_leg(found: Diagnosis) -> Text:
    """Shares of the position's excess by joint, as legs lie from above; nothing for another robot."""
    share = dict.fromkeys(JOINT_NAMES, 0.0)
    for place in found.where:
        if place["signal"] == "pos" and place["joint"] in share:
            share[str(place["joint"])] += float(place["share"])
    text = Text()
    if any(share.values()):
        text.append(" position by leg, front above: hip, knee\n")
        for left, right in (("fl", "fr"), ("rl", "rr")):
            both = (
                f"{leg} {percent(share[f'hip_{leg}']):>5} {percent(share[f'knee_{leg}']):>5}" for leg in (left, right)
            )
            text.append(f"   {'      '.join(both)}\n")
    return text
