"""Robots of a set that are recorded through the virtual robot's bus: real packets, real timing, our own engine.

The virtual robot is a process of its own in stepped time; an engine plays the set's commands on it and records. Scatter goes
into its scenario as values of motors and as effects within their tolerance. Where a leg was let go, the engine lets the command
follow it and catches it where it hangs, so that these rows differ from the set's table.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from openant_tools.blind.commands import RATE_HZ, Motion
from openant_tools.blind.draw import Answer, Drawn
from openant_tools.blind.log import facts_of
from openant_tools.blind.robot import TrueRobot, true_robot
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.guards import Guards
from openant_tools.comms.messages import ImuConfig
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT_COUNTS, kit
from openant_tools.virtual.process import virtual_robot

__all__ = ["record_through_bus", "scenario_of"]

#: s of standing before each run, and of standing up before the first on the floor
SETTLE_S = 0.6
#: Blocked joints strain and ill robots fall: nothing is to be saved here.
NO_GUARDS = Guards(None, None, None, temperature_margin_k=None, voltage=False, silent_s=None)
#: What only one setup shows, or has.
_FLOOR_ONLY = frozenset({"floor_friction", "contact_softness", "foot_adhesion", "floor_tilt", "cable_drag"})


def scenario_of(answer: Answer, setup: str, heading_rad: float) -> str:
    """The scenario of a robot, as TOML: scatter and effects."""
    robot = true_robot(replace(answer, effects=(), outside=None))
    document: dict[str, Any] = {
        "seed": answer.seed % 2**31,
        "robot": {"kit": "standard", "setup": setup, "pose": "home", "heading_rad": heading_rad, "step_s": 5e-4},
        "clock": {"mode": "stepped"},
        "camera": {"present": False},
        "supply": {"volts": robot.servos.supply_v, "resistance_ohm": robot.servos.supply_ohm},
        "room": {"ambient_c": robot.ambient_c},
        "imu": _imu(robot),
        "servo": [_servo(robot, k) for k in range(len(JOINTS))],
        "effect": [_entry(drawn) for drawn in (*_scatter(robot, setup), *_wrong(answer, robot))],
    }
    return tomlkit.dumps(document)


def _imu(robot: TrueRobot) -> dict[str, Any]:
    senses = robot.senses
    return {
        "mount_rpy": senses.mount_rad.tolist(), "gyro_bias": senses.gyro_bias.tolist(),
        "acc_bias": senses.acc_bias.tolist(), "gyro_noise": senses.gyro_noise, "acc_noise": senses.acc_noise,
    }  # fmt: skip


def _servo(robot: TrueRobot, k: int) -> dict[str, Any]:
    servos = robot.servos
    joint = list(JOINTS.values())[k]
    nominal = kit("standard").servo(joint.kind)
    gain = float(nominal.register("position_p_gain").default or 0) / nominal.position_p_divisor
    return {
        "joint": joint.name,
        "pwm_limit": PLATFORM_PWM_LIMIT_COUNTS,
        "mount_rad": np.pi + float(servos.zero[k]),
        "motor": {
            "kt": float(servos.kt[k]), "ke": float(servos.ke[k]), "viscous": float(servos.viscous[k]),
            "armature": float(servos.rotor[k] + robot.mechanics.output_armature[k]),
            "stiffness_scale": float(servos.p_gain[k]) / gain, "coulomb_nm": float(servos.coulomb[k]),
            "encoder_noise_rad": robot.senses.encoder_rad, "current_noise_a": robot.senses.current_a,
            "action_delay_s": robot.clocks.base_s,
        },
    }  # fmt: skip


def _scatter(robot: TrueRobot, setup: str) -> list[Drawn]:
    """Links, floor and torso, as effects so small that they are none."""
    mechanics = robot.mechanics
    small = [
        Drawn("link_mass", (name,), {"scale": float(mechanics.link_scale[k])}, "small") for k, name in enumerate(JOINTS)
    ]
    if setup == "floor":
        across = float(np.hypot(*mechanics.gravity[:2]))
        small += [
            Drawn("floor_friction", "body", {"sliding": mechanics.friction}, "small"),
            Drawn("contact_softness", "body", {"time_constant_s": mechanics.contact_s}, "small"),
            Drawn(
                "floor_tilt", "body",
                {
                    "angle_rad": float(np.arcsin(across / 9.81)),
                    "direction": float(np.arctan2(mechanics.gravity[1], mechanics.gravity[0])),
                },
                "small",
            ),
        ]  # fmt: skip
        if mechanics.torso_kg > 0:
            small.append(Drawn("payload", "body", {"mass_kg": mechanics.torso_kg}, "small"))
    return small


def _wrong(answer: Answer, robot: TrueRobot) -> list[Drawn]:
    """The answer's effects; what would set a value and forget the robot's own is made to keep it."""
    out = []
    for drawn in answer.effects:
        if drawn.effect == "link_mass":
            # The virtual robot's entry replaces a link's scale: keep each link's own.
            own = robot.mechanics.link_scale
            out += [
                Drawn("link_mass", (name,), {"scale": drawn.parameters["scale"] * float(own[k])}, drawn.size)
                for k, name in enumerate(JOINTS)
            ]
        else:
            out.append(drawn)
    return out


def _entry(drawn: Drawn) -> dict[str, Any]:
    joints = drawn.joints if isinstance(drawn.joints, str) else list(drawn.joints)
    return {"effect": drawn.effect, "joints": joints, "parameters": dict(drawn.parameters)}


def record_through_bus(
    answer: Answer, played: Sequence[Motion], keep: Callable[[Motion, Run], None] = lambda motion, run: None
) -> list[Run]:
    """Play a set's motions on one robot and record them; `keep` gets each run when it is done."""
    runs = []
    places = list(dict.fromkeys((motion.setup, motion.heading_rad) for motion in played))
    for place in places:
        here = [motion for motion in played if (motion.setup, motion.heading_rad) == place]
        for motion, run in _record_here(answer, here):
            keep(motion, run)
            runs.append(run)
    return runs


def _record_here(answer: Answer, played: Sequence[Motion]) -> list[tuple[Motion, Run]]:
    first, robot = played[0], true_robot(answer)
    done = []
    with tempfile.TemporaryDirectory(prefix="openant-blind-") as name:
        folder = Path(name)
        scenario = folder / "robot.toml"
        scenario.write_text(scenario_of(answer, first.setup, first.heading_rad), encoding="utf-8")
        with virtual_robot(str(scenario)) as found:
            assert found["bus"] is not None
            assert found["imu"] is not None
            config = replace(
                config_of_unknown_robot(found["bus"], found["control"], rate_hz=RATE_HZ, imu=ImuConfig(found["imu"])),
                guards=NO_GUARDS,
            )
            with EngineProcess(config) as engine:
                engine.ask(messages.Torque(True))
                for motion in played:
                    engine.ask(messages.Ramp(motion.commands[0]))
                    engine.ask(messages.Hold(SETTLE_S))
                    path = folder / f"{motion.name}.mcap"
                    engine.ask(messages.Record(str(path), facts_of(motion)))
                    engine.ask(messages.Play(motion.commands, motion.name, motion.limp if motion.limp.any() else None))
                    engine.ask(messages.StopRecording())
                    done.append((motion, _as_logged(read_run(path), motion, robot)))
                engine.ask(messages.Torque(False))
    return done


def _as_logged(run: Run, motion: Motion, robot: TrueRobot) -> Run:
    """With the facts that all runs of a set have, and the stamps that a host writes: stepped time has none of its scatter."""
    facts = replace(facts_of(motion), resolution=run.facts.resolution)
    chance = np.random.default_rng([robot.seed, len(motion.name), round(100 * motion.seconds)])
    off = np.clip(chance.standard_normal(len(run.t)), -3, 3) * robot.clocks.stamp_s
    t = run.t + off
    return Run(motion.name, facts, t - t[0], {**run.columns, "cmd_t": run.column("cmd_t") + off - t[0]})
