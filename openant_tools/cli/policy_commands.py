"""A trained policy as a table of commands, for commands that play what was recorded."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = ["policy_commands"]

#: s of robot time that a policy walks in the simulation: many rounds of any gait, and both ways of back-and-forth
POLICY_S = 60.0


def policy_commands(run: Path, out: Path, folder: RobotFolder | None) -> Path:
    """Let the policy of a training run walk in the simulation, and write what it commanded beside `out`.

    Args:
        folder: the robot in whose model it walks; None for the one it was trained on.

    Raises:
        BadInput: no training run, or one of another robot.
    """
    import numpy as np

    from openant_agents.policies import load_policy
    from openant_agents.rollout import commands_of
    from openant_agents.runs import read_facts
    from openant_tools.cli.learning import need_agents
    from openant_tools.cli.walking import SIMULATED_ID, environment
    from openant_tools.recording.run import Facts, Run
    from openant_tools.recording.tables import write_table

    need_agents()
    options = dict(read_facts(run)["env"]["options"])
    for name in ("virtual", "clock"):
        options.pop(name, None)
    if folder is not None:
        options.pop("kit", None)
        options["robot"] = os.path.abspath(folder.path)
    with environment(SIMULATED_ID, options, run / "recordings") as env:
        commands = commands_of(env, load_policy(run, env), seconds=POLICY_S)
        joints, dt = tuple(env.unwrapped.robot.joints), float(env.unwrapped.dt)
    table = out.with_name(f"{out.stem}-policy.parquet")
    columns = {f"cmd.{joint}": column for joint, column in zip(joints, commands.T, strict=True)}
    facts = Facts(joints=joints, setup="floor", protocol="walk", notes=f"commanded by {run} in the simulation")
    write_table(Run(table.stem, facts, dt * np.arange(len(commands), dtype=np.float64), columns), table)
    return table
