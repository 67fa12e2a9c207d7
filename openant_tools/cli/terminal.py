"""`openant` without a command: the terminal program, here or in a browser."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

from openant_tools.errors import BadInput

__all__ = ["serve", "terminal"]


def terminal(robot: Path | None, virtual_source: str | None) -> int:
    """Run the terminal program; its exit code."""
    from openant_tools.cli.leaving import end_with_the_terminal
    from openant_tools.tui.app import run

    end_with_the_terminal()
    return run(_folder(robot), virtual_source)


def serve(port: int, robot: Path | None, virtual_source: str | None) -> int:
    """Offer the terminal program to a browser on this machine until Ctrl-C."""
    try:
        from textual_serve.server import Server
    except ModuleNotFoundError:
        raise BadInput("the browser needs textual-serve", remedy="pip install 'openant-tools[serve]'") from None
    words = [sys.executable, "-m", "openant_tools.cli", "--robot", str(_folder(robot))]
    words += ["--virtual", virtual_source] if virtual_source is not None else []
    Server(shlex.join(words), port=port, title="Open Ant").serve()
    return 0


def _folder(robot: Path | None) -> Path:
    """The robot's folder, which need not be one yet."""
    path = robot or Path(os.environ.get("OPENANT_ROBOT", "."))
    return path.parent if path.name.endswith(".toml") else path
