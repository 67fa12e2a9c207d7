"""The command line as the face of a procedure: rich on stderr, questions where a terminal is attached."""

from __future__ import annotations

import math
import select
import sys
from collections.abc import Callable, Sequence

import click
from rich.console import Console
from rich.markup import escape
from rich.prompt import Confirm, FloatPrompt, Prompt

from openant_tools.cli.hardware import need_moving, need_terminal
from openant_tools.cli.log import is_quiet, mention
from openant_tools.cli.streams import has_terminal
from openant_tools.errors import BadInput
from openant_tools.numbers import number, percent, span
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.step import (
    Answer,
    Ask,
    Drawing,
    Event,
    Hands,
    Intent,
    Live,
    Progress,
    Say,
    StepAt,
    change_lines,
)

__all__ = ["CommandFace", "echo_finding", "echo_numbers"]

_GLYPHS = {"info": ("·", "dim"), "ok": ("✓", "green"), "warn": ("▲", "yellow"), "fail": ("✗", "red")}
_PLAIN = {"·": "-", "✓": "ok", "▲": "!", "✗": "x", "→": "->", "…": "..."}
BAR_WIDTH = 24


class CommandFace:
    """Shows events as lines; asks, unless `yes` grants everything and takes the defaults.

    Args:
        yes: nobody is asked: intents are granted, defaults taken.
        hands: who does what hands must do where nobody is asked (a virtual robot's); None for the builder.
    """

    def __init__(self, *, yes: bool, hands: Callable[[Hands], None] | None = None) -> None:
        self.console = Console(stderr=True, highlight=False)
        self._yes = yes
        self._hands = hands
        self._live, self._watching = 0, False
        self._said = ("", 0.0)

    def answer(self, event: Event) -> Answer:
        """Show one event; what it is answered with."""
        if not isinstance(event, Live):
            self._live = 0
        if isinstance(event, Intent | Hands | Ask):
            self._watching = False
        match event:
            case Progress(share, words):
                self._progress(share, words)
            case Say(words, level):
                glyph, style = _GLYPHS[level]
                self._line(f"[{style}]{glyph}[/{style}] {escape(words)}")
            case Drawing(words, drawing, picture):
                self._line(
                    escape(words) + (f"\n{escape(drawing)}" if drawing else "") + (f" ({picture})" if picture else "")
                )
            case StepAt(step, place, count, finding):
                if finding is None:
                    mention(f"{place}/{count} {step.title}")
                else:
                    click.echo(f"{place}/{count} {step.title}: ", nl=False)
                    echo_finding(finding)
            case Live():
                return self._show(event)
            case Intent() | Hands() | Ask():
                try:
                    return self._asked(event)
                except EOFError:  # the terminal was closed, or Ctrl-D: nobody is there any more
                    raise KeyboardInterrupt from None
        return None

    def _asked(self, event: Intent | Hands | Ask) -> Answer:
        match event:
            case Intent():
                return self._grant(event)
            case Hands():
                return self._by_hand(event)
        return self._ask(event)

    def _progress(self, share: float | None, words: str) -> None:
        """One line where something new begins, and one a quarter of the way: lines stay, unlike a bar."""
        if is_quiet():
            return
        before, at = self._said
        if words != before or (share or 0.0) - at > 0.25:
            self._said = (words, share or 0.0)
            self._line(f"[dim]{'' if share is None else f'{percent(share)} '}{escape(words)} …[/dim]")

    def _line(self, markup: str) -> None:
        encoding = (self.console.encoding or "ascii").lower()
        if not encoding.startswith("utf"):
            for sign, plain in _PLAIN.items():
                markup = markup.replace(sign, plain)
        self.console.print(markup, soft_wrap=True)

    def _grant(self, intent: Intent) -> bool:
        self._line(
            f"[bold]will {escape(intent.words)}[/bold]" + (" [yellow](it may move)[/yellow]" if intent.moves else "")
        )
        for line in change_lines(intent.registers):
            self._line(f"    {escape(line)}")
        if intent.moves:
            need_moving()
        if self._yes:
            return True
        need_terminal("it would write or move")
        return Confirm.ask("Do it?", console=self.console, default=True)

    def _by_hand(self, hands: Hands) -> bool:
        whose = "hands" if self._hands is None else "virtual hands"
        self._line(f"[cyan]{whose}:[/cyan] {escape(hands.words)}")
        if self._hands is not None:
            self._hands(hands)
        elif not self._yes and not hands.while_watching:
            need_terminal("it needs your hands")
            Prompt.ask("Enter when done", console=self.console, default="", show_default=False)
        elif self._yes and not hands.while_watching:
            raise BadInput(
                f"hands are needed: {hands.words}", remedy="run it in a terminal, without --yes, or with --virtual"
            )
        return True

    def _ask(self, ask: Ask) -> Answer:
        if self._yes:
            if ask.default is None:
                raise BadInput(
                    f"nobody is there to answer: {ask.question}", remedy="run it in a terminal, without --yes"
                )
            self._line(f"[dim]? {escape(ask.question)} {escape(str(ask.default))}[/dim]")
            return ask.default
        need_terminal("it has a question")
        question = escape(ask.question)
        if len(ask.choices) == 1:
            Prompt.ask(f"{question} [dim](Enter)[/dim]", console=self.console, default="", show_default=False)
            return ask.choices[0]
        if ask.choices:
            default = ask.default if isinstance(ask.default, str) else ask.choices[0]
            return self._choice(question, ask.choices, default)
        if ask.unit == "text":
            return Prompt.ask(
                question, console=self.console, default=str(ask.default or ""), show_default=bool(ask.default)
            )
        while True:
            given = FloatPrompt.ask(
                f"{question} {escape(f'[{ask.unit}]')}" if ask.unit else question,
                console=self.console,
                default=ask.default,
            )
            if (
                isinstance(given, int | float)
                and (ask.low is None or given >= ask.low)
                and (ask.high is None or given <= ask.high)
            ):
                return float(given)
            self._line(f"[red]✗[/red] from {span(ask.low, ask.high, ask.unit)}")

    def _choice(self, question: str, choices: Sequence[str], default: str) -> str:
        """One of several, or as much of its beginning as no other has."""
        offered = f"{question} [magenta]{escape('[' + '/'.join(choices) + ']')}[/magenta]"
        while True:
            given = Prompt.ask(offered, console=self.console, default=default).strip().lower()
            meant = [one for one in choices if one.lower() == given] or [
                one for one in choices if one.lower().startswith(given)
            ]
            if len(meant) == 1:
                return meant[0]
            self._line(f"[red]✗[/red] one of: {escape(', '.join(choices))}")

    def _show(self, live: Live) -> bool:
        """Bars that stay in place on a terminal, nothing where the output goes to a file; whether Enter was pressed since."""
        watched = not self._yes and has_terminal()
        if watched and not self._watching:  # a key that was pressed before counts for nothing that comes later
            while _entered():
                pass
        self._watching = watched
        if self.console.is_terminal and live.low:
            if self._live:
                sys.stderr.write(f"\x1b[{self._live}A")
            for joint, value in live.values.items():
                if not math.isfinite(value):
                    sys.stderr.write(f"\x1b[2K  {joint:8} does not answer\n")
                    continue
                low, high = live.low.get(joint, value - 1), live.high.get(joint, value + 1)
                at = round(min(max((value - low) / max(high - low, 1e-9), 0.0), 1.0) * (BAR_WIDTH - 1))
                bar = "".join("#" if k == at else "-" for k in range(BAR_WIDTH))
                sys.stderr.write(
                    f"\x1b[2K  {joint:8} {bar} {number(value, live.unit, sign=True, decimals=1)} {live.marks.get(joint, '')}\n"
                )
            self._live = len(live.values)
        return watched and _entered()


def _entered() -> bool:
    """Whether a line was entered that nobody has read yet; it is read."""
    return bool(select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline())


def echo_finding(finding: Finding) -> None:
    """The result of a step, for stdout: the sentence, what is wrong, what is next."""
    click.echo(f"{finding.verdict if finding.ok else finding.verdict.upper()}: {finding.what}")
    for words in finding.lines:
        click.echo(f"  {words}")
    if finding.next_action:
        click.echo(f"next: {finding.next_action}")


def echo_numbers(finding: Finding) -> None:
    """The numbers that a finding rests on, for stdout, one below the other; what is not as it should be is marked."""
    names = max((len(one.name) for one in finding.evidence), default=0)
    values = max((len(one.words) for one in finding.evidence), default=0)
    for one in finding.evidence:
        wanted = f"   {'✗' if one.outside else '✓'} {one.wanted}" if one.wanted else ""
        click.echo(f"{one.name:{names}}  {one.words:>{values}}{wanted}")
