"""A list to choose from; in jump mode each line has a letter of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from textual.geometry import Offset
from textual.widgets import OptionList

__all__ = ["Choices"]


class Choices(OptionList):
    """Lines to choose from with arrows and Enter, a mouse, or a jump."""

    HELP = """\
# A list

Arrow keys go through it, `Enter` chooses. `Ctrl-O` puts a letter on each line.
"""

    def jump_points(self) -> Iterable[tuple[Offset, Callable[[], None]]]:
        """See `jump.JumpPoints`; lines that take two rows are jumped to at their first."""
        seen = set()
        for line, (index, _) in enumerate(self._lines):
            at = line - int(self.scroll_offset.y)
            if index not in seen and 0 <= at < self.size.height:
                yield self.region.offset + Offset(0, at), partial(self._choose, index)
            seen.add(index)

    def _choose(self, index: int) -> None:
        self.focus()
        self.highlighted = index
        self.action_select()
