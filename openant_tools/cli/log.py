"""The log of the command line: warnings on stderr, all of it in one rotating file in the user's state folder.

A line of the file is `2026-03-01 12:00:00,000 WARNING openant_env[4711]: words`; on stderr the words alone.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["FILE", "aside", "begin", "command_line", "is_quiet", "log_options", "mention", "state_folder"]

FILE = "openant.log"
LARGEST, KEPT = 1_000_000, 3
OURS = ("openant_tools", "openant_env", "openant_agents")
_LEVELS = {-1: logging.ERROR, 0: logging.WARNING, 1: logging.INFO, 2: logging.DEBUG}

_stderr: logging.Handler | None = None
_level = 0
_argv: list[str] = []


class _Stderr(logging.StreamHandler[TextIO]):
    """Writes to whatever stands for stderr at that moment."""

    def __init__(self) -> None:
        logging.Handler.__init__(self)

    @property
    def stream(self) -> TextIO:  # type: ignore[override]
        return sys.stderr


def state_folder() -> Path:
    """Where programs of this user keep what outlives them: $XDG_STATE_HOME/openant, by default below ~/.local/state."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "openant"


def begin(argv: list[str]) -> None:
    """Take the log up, once a process; a state folder that cannot be written to costs the file, never the command."""
    global _stderr, _level, _argv
    _argv = argv
    root = logging.getLogger()
    for handler in [one for one in root.handlers if one.get_name() == FILE]:
        root.removeHandler(handler)
        handler.close()
    _level = 0
    _stderr = _Stderr()
    _stderr.setFormatter(logging.Formatter("%(message)s"))
    _stderr.setLevel(_LEVELS[0])
    handlers: list[logging.Handler] = [_stderr]
    try:
        folder = state_folder()
        folder.mkdir(parents=True, exist_ok=True)
        file = logging.handlers.RotatingFileHandler(folder / FILE, maxBytes=LARGEST, backupCount=KEPT, encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s[%(process)d]: %(message)s"))
        file.handleError = lambda record: None  # type: ignore[method-assign]  # a full disk
        handlers.append(file)
    except (OSError, RuntimeError):  # nobody's home
        pass
    for handler in handlers:
        handler.set_name(FILE)
        root.addHandler(handler)
    for name in OURS:
        logging.getLogger(name).setLevel(logging.INFO)
    logging.getLogger("openant_tools").info("openant %s", " ".join(argv))


def command_line() -> str:
    """This process's command as a shell takes it; `openant` alone where it began otherwise."""
    return shlex.join(["openant", *_argv])


def is_quiet() -> bool:
    """Whether -q was given: nothing but errors on stderr."""
    return _level < 0


def mention(words: str) -> None:
    """Say a line on stderr that is no error: not with -q."""
    if not is_quiet():
        click.echo(words, err=True)


def aside(**options: Any) -> Console:
    """A console on stderr for bars and lines that are no errors: silent with -q."""
    from rich.console import Console

    return Console(stderr=True, quiet=is_quiet(), **options)


def log_options() -> list[click.Option]:
    """`-v` and `-q`, for every command."""
    return [
        click.Option(
            ["-v", "--verbose"], count=True, is_eager=True, expose_value=False, callback=_louder,
            help="Say more on stderr; twice: everything.",
        ),
        click.Option(
            ["-q", "--quiet"], is_flag=True, is_eager=True, expose_value=False, callback=_quieter,
            help="Say nothing on stderr but errors.",
        ),
    ]  # fmt: skip


def _louder(context: click.Context, option: click.Parameter, value: int) -> None:
    if value:
        _set(min(value, 2))


def _quieter(context: click.Context, option: click.Parameter, value: Any) -> None:
    if value:
        _set(-1)


def _set(level: int) -> None:
    global _level
    _level = level
    if _stderr is not None:
        _stderr.setLevel(_LEVELS[level])
    for name in OURS:
        logging.getLogger(name).setLevel(min(logging.INFO, _LEVELS[level]))
