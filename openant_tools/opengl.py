"""MuJoCo is imported without a window library; which OpenGL was asked for stays known to who draws with it."""

from __future__ import annotations

import os

__all__ = ["CHOSEN_GL", "load_no_window_library"]

#: the MUJOCO_GL that a command was given
CHOSEN_GL = "OPENANT_MUJOCO_GL"


def load_no_window_library() -> None:
    """Have MuJoCo, where it is not imported yet, prepare no renderer of its own; `openant_env.rendering` chooses by what was asked.

    As it is imported it loads a window library, for a renderer that nothing of ours uses: a third of its time to load, and a process
    started besides. A MUJOCO_GL that it does not know would end the import.
    """
    os.environ.setdefault(CHOSEN_GL, os.environ.get("MUJOCO_GL", ""))
    os.environ["MUJOCO_GL"] = "disable"
