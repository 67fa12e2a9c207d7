"""The bodies of the batch simulator: the nominal robot's links and floor, every length, mass and contact a little off."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from openant_tools.blind.robot import Mechanics
from openant_tools.robot.joints import JOINTS, LEGS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.robot.mjcf import HOME_HEIGHT, nominal_mjcf

__all__ = ["STEP_S", "build"]

#: s; half of the candidates' step
STEP_S = 5e-4
_INTEGRATORS = {"euler": mujoco.mjtIntegrator.mjINT_EULER, "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT}


def build(m: Mechanics, setup: str, heading_rad: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A robot on its stand or on its feet at the home pose, without motors: torques come in by `qfrc_applied`."""
    spec = mujoco.MjSpec.from_string(nominal_mjcf("standard"))
    for thing in [*spec.actuators, *spec.keys]:
        spec.delete(thing)
    option = spec.option
    option.timestep, option.integrator = STEP_S, _INTEGRATORS[m.integrator]
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL if m.pyramidal else mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = m.impratio
    option.gravity = m.gravity if setup == "floor" else np.array([0.0, 0.0, -9.81])
    floor = spec.geom("floor")
    floor.friction[0], floor.solref[:], floor.solimp[:3] = m.friction, (m.contact_s, m.contact_damping), m.solimp
    _joints(spec, m)
    _lengths(spec, m)
    spec.geom("torso").mass += m.torso_kg
    for n, (mass, place) in enumerate(m.payloads):
        spec.body("torso").add_geom(
            name=f"payload_{n}", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.02, 0.02], pos=place, mass=mass,
            contype=0, conaffinity=0,
        )  # fmt: skip
    if setup == "stand":
        spec.delete(spec.joint("root"))
        floor.contype = floor.conaffinity = 0
    _outside(spec, m, setup, heading_rad)
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, joint in JOINTS.items():
        data.qpos[model.joint(name).qposadr[0]] = HOME_RAD[joint.kind]
    if setup == "floor":
        half = heading_rad / 2
        data.qpos[:7] = (0.0, 0.0, HOME_HEIGHT + 0.006, math.cos(half), 0.0, 0.0, math.sin(half))
    mujoco.mj_forward(model, data)
    return model, data


def _joints(spec: mujoco.MjSpec, m: Mechanics) -> None:
    for k, (name, joint) in enumerate(JOINTS.items()):
        hinge = spec.joint(name)
        hinge.damping[:], hinge.frictionloss, hinge.armature = 0.0, 0.0, float(m.output_armature[k])
        spec.geom(f"{'upper' if joint.kind == 'hip' else 'lower'}_{joint.leg.name}").mass *= float(m.link_scale[k])
        if name in m.blocked:
            low, high = spec.find_default(joint.kind).joint.range
            # The way home stays open: the stop lies on the far side.
            angle = m.blocked[name]
            hinge.range = [low, angle] if angle >= 0 else [angle, high]


def _lengths(spec: mujoco.MjSpec, m: Mechanics) -> None:
    for leg, factors in zip(LEGS, m.lengths, strict=True):
        for part, factor in zip(("root", "upper", "lower"), factors, strict=True):
            geom = spec.geom(f"{part}_{leg.name}")
            geom.fromto = np.asarray(geom.fromto) * factor
        spec.body(f"upper_leg_{leg.name}").pos *= factors[0]
        spec.body(f"lower_leg_{leg.name}").pos *= factors[1]


def _outside(spec: mujoco.MjSpec, m: Mechanics, setup: str, heading_rad: float) -> None:
    """What the catalogue has no name for."""
    if m.outside is None:
        return
    joint, strength = JOINTS[m.outside_joint], m.outside_strength
    leg = joint.leg
    across = np.array([-leg.y_sign, leg.x_sign, 0.0]) / math.sqrt(2)
    lower = spec.geom(f"lower_{leg.name}")
    match m.outside:
        case "mount_resonance":
            # Some 4 g·m² on 8 N·m/rad: about 7 Hz.
            spec.body(f"leg_{leg.name}").add_joint(
                name="mount", type=mujoco.mjtJoint.mjJNT_HINGE, axis=across, stiffness=8.0 / strength, damping=0.02
            )
        case "long_leg":
            lower.fromto = np.asarray(lower.fromto) * (1 + 0.22 * strength)
            lower.mass *= 1 + 0.22 * strength
        case "lost_foot":
            lower.fromto = np.asarray(lower.fromto) * (1 - 0.2 * strength)
            lower.size[0] *= 0.6
            lower.mass *= 0.65
        case "rubber_band":
            other = LEGS[(LEGS.index(leg) + 1) % len(LEGS)]
            ends = []
            for one in (leg, other):
                reach = 0.06 * np.array([one.x_sign, one.y_sign, 0.0])
                spec.body(f"lower_leg_{one.name}").add_site(name=f"band_{one.name}", pos=reach)
                ends.append(f"band_{one.name}")
            band = spec.add_tendon(name="band", stiffness=6.0 * strength, springlength=[0.0, 0.14])
            for end in ends:
                band.wrap_site(end)
        case "loose_battery":
            battery = spec.body("torso").add_body(name="battery", pos=[0.0, 0.0, -0.02])
            battery.add_joint(
                name="battery", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], range=[-0.035, 0.035], damping=0.1,
                frictionloss=0.05,
            )  # fmt: skip
            battery.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.015, 0.01], mass=0.18 * strength, contype=0, conaffinity=0
            )
        case "uneven_floor" if setup == "floor":
            towards = heading_rad + math.atan2(leg.y_sign, leg.x_sign)
            height = 0.008 * strength
            slab = spec.worldbody.add_geom(
                name="slab", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.05, height],
                pos=[0.28 * math.cos(towards), 0.28 * math.sin(towards), 0.0], priority=1,
            )  # fmt: skip
            floor = spec.geom("floor")
            slab.friction, slab.solref, slab.solimp = floor.friction, floor.solref, floor.solimp
        case _:
            pass
