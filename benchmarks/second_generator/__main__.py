"""A maker of blind robots in Drake: one drawn answer in, run tables out.

    python benchmarks/second_generator ANSWER.json FOLDER [--robot arm] [--motion policy]
    python benchmarks/second_generator --check MODEL.xml

By itself or as `openant gap blind make --maker "PYTHON benchmarks/second_generator"`. Nothing here is the diagnosis's: the
physics, the servo, the motions and the sensors are other people's, as far as one author can be two people. Exit code 3: this
physics cannot have what was drawn.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from answer import Answer, CannotHave, read_answer
from drives import Drives
from logs import senses_of, write_run
from machine import ant, arm, truth
from motions import protocol, walks
from play import clocks_of, play

STEPS_S = (6e-4, 1e-3, 1e-3)


def make(answer: Answer, folder: Path, *, robot: str = "ant", motion: str = "protocol", short: bool = False) -> None:
    """Write the runs of one robot; the same for the same answer.

    Args:
        short: one run of each setup alone.
    """
    policy = motion == "policy"
    chance = np.random.default_rng([answer.seed, 2])
    machine = (ant if robot == "ant" else arm)(answer, chance)
    body = truth(machine, answer, chance)
    dt = float(chance.choice(STEPS_S))
    if answer.names & {"backlash", "joint_compliance"}:
        dt = 5e-4
    drives = Drives(machine, answer, body.armature, dt, chance)
    clocks = clocks_of(machine, answer, policy, chance)
    senses = senses_of(machine, answer, policy, chance)
    if not senses.cmd_t:
        # A log that does not say when its commands left sends them right after its rows.
        clocks.gap_s = min(clocks.gap_s, 3e-4)
    played = (walks if policy else protocol)(machine, chance)
    if short:
        played = list({one.setup: one for one in reversed(played)}.values())
    (folder / "nominal.xml").write_text(machine.model, encoding="utf-8")
    for one in played:
        trace = play(machine, body, drives, clocks, one, chance)
        if not np.isfinite(trace.encoder).all():
            raise RuntimeError(f"{answer.robot}, {one.name}: the simulation blew up")
        write_run(folder, machine, drives, clocks, senses, one, trace, body.tilt, chance)


def main() -> int:
    parser = argparse.ArgumentParser(prog="second_generator", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", type=Path, metavar="MODEL.xml", help="make a healthy and an ill robot, and compare")
    parser.add_argument("--robot", choices=["ant", "arm"], default="ant")
    parser.add_argument("--motion", choices=["protocol", "policy"], default="protocol")
    parser.add_argument("answer", type=Path, nargs="?")
    parser.add_argument("folder", type=Path, nargs="?")
    given = parser.parse_args()
    if given.check:
        from check import check

        return check(given.check, make)
    if given.answer is None or given.folder is None:
        parser.error("give ANSWER.json and FOLDER, or --check MODEL.xml")
    if given.robot == "arm" and given.motion == "policy":
        parser.error("an arm does not walk: --motion policy is the Ant's")
    try:
        make(read_answer(given.answer), given.folder, robot=given.robot, motion=given.motion)
    except CannotHave as cannot:
        print(cannot, file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
