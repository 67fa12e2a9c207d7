"""Drake's part: bodies and contacts (SAP, point contact), one step at a time."""

from __future__ import annotations

import logging
import math
import xml.etree.ElementTree as ET

import numpy as np
from machine import FOOT_N_M, HOME, NOMINAL_S, Machine, TrueBody
from pydrake.geometry import AddContactMaterial, ProximityProperties, Role, RoleAssign
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, DiscreteContactApproximation
from pydrake.multibody.tree import JacobianWrtVariable, LinearSpringDamper, RevoluteSpring
from pydrake.systems.framework import DiagramBuilder

__all__ = ["World"]

logging.getLogger("drake").setLevel(logging.ERROR)

GRAVITY = 9.81
#: m, of the torso's centre above the floor before it settles at the home pose
START_M = 0.16


def _for_drake(machine: Machine, body: TrueBody, floor: bool, at_joint: np.ndarray, viscous: np.ndarray) -> str:
    """The true MJCF with motors in place of position servos, and on the stand without free joint and floor."""
    root = body.tree
    actuator, world = root.find("actuator"), root.find("worldbody")
    assert actuator is not None
    assert world is not None
    for one in list(actuator):
        one.tag = "motor"
        one.attrib.pop("class", None)
        one.set("gear", "1")
    for default in root.iter("default"):
        for one in default.findall("position"):
            default.remove(one)
    for tag in ("sensor", "keyframe", "visual", "statistic", "asset"):
        for one in root.findall(tag):
            root.remove(one)
    for one in root.iter():
        one.attrib.pop("material", None)
        if one.get("friction") and one.tag == "geom":
            one.set("friction", f"{body.friction:.6g}")
    for parent in list(root.iter("body")):
        for one in list(parent):
            if one.tag in ("light", "camera", "site") or (one.tag == "freejoint" and not floor):
                parent.remove(one)
    for one in list(world):
        if one.tag == "geom" and not floor:
            world.remove(one)
        elif one.tag == "geom":
            one.set("friction", f"{body.friction:.6g}")
    ranges = {
        str(default.get("class")): tuple(float(v) for v in str(joint.get("range")).split())
        for default in root.iter("default")
        if (joint := default.find("joint")) is not None
    }
    for one in root.iter("joint"):
        name = one.get("name")
        if name not in machine.joints:
            continue
        k = machine.joints.index(name)
        one.set("armature", f"{at_joint[k]:.8g}")
        one.set("damping", f"{viscous[k]:.8g}")
        if name in body.blocked:
            # The way home stays open: the stop lies on the far side.
            kind, angle = machine.kinds[k], body.blocked[name]
            low, high = ranges[kind]
            low, high = (low, angle) if angle > HOME[kind] else (angle, high)
            one.set("range", f"{low:.6g} {high:.6g}")
    return ET.tostring(root, encoding="unicode")


class World:
    """A robot on its stand or on the floor; `q`, `v` are (n,) of its servos' joints."""

    def __init__(
        self,
        machine: Machine,
        body: TrueBody,
        floor: bool,
        heading: float,
        dt: float,
        at_joint: np.ndarray,
        viscous: np.ndarray,
    ):
        self.dt, self.floor, self.body = dt, floor, body
        builder = DiagramBuilder()
        plant, scene = AddMultibodyPlantSceneGraph(builder, dt)
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
        Parser(plant).AddModelsFromString(_for_drake(machine, body, floor, at_joint, viscous), ".xml")
        if body.mount:
            plant.AddForceElement(RevoluteSpring(plant.GetJointByName("mount"), 0.0, body.mount[1]))
        if body.band:
            one, other, stiffness = body.band
            legs = [plant.GetBodyByName(name) for name in (one, other)]
            places = [
                np.array([math.copysign(0.06, x), math.copysign(0.06, y), 0.0]) for x, y in map(_corner, (one, other))
            ]
            plant.AddForceElement(LinearSpringDamper(legs[0], places[0], legs[1], places[1], 0.14, stiffness, 0.02))
        tilt, towards = body.tilt if floor else (0.0, 0.0)
        across = GRAVITY * math.sin(tilt)
        plant.mutable_gravity_field().set_gravity_vector(
            [across * math.cos(towards), across * math.sin(towards), -GRAVITY * math.cos(tilt)]
        )
        plant.Finalize()
        self._soften(plant, scene)
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.plant, self.here = plant, plant.GetMyMutableContextFromRoot(self.context)
        joints = [plant.GetJointByName(name) for name in machine.joints]
        self.rows = np.array([joint.position_start() for joint in joints])
        self.columns = plant.num_positions() + np.array([joint.velocity_start() for joint in joints])
        order = [plant.get_joint_actuator(index).joint().name() for index in plant.GetJointActuatorIndices()]
        self.order = np.array([machine.joints.index(name) for name in order])
        for joint, kind in zip(joints, machine.kinds, strict=True):
            joint.set_angle(self.here, HOME[kind])
        if floor:
            torso = plant.GetBodyByName("torso")
            plant.SetFreeBodyPose(self.here, torso, RigidTransform(RollPitchYaw(0, 0, heading), [0, 0, START_M]))
            self.at, self.moves = torso.floating_positions_start(), torso.floating_velocities_start_in_v()
        self.torques, self.forces = plant.get_actuation_input_port(), plant.get_applied_generalized_force_input_port()
        self.pulled = floor and (body.cable is not None or body.tether is not None or body.adhesion_n > 0)
        if body.adhesion_n:
            self.feet = [plant.GetBodyByName(f"lower_leg_{leg}") for leg in ("rr", "fr", "fl", "rl")]
        self._read()

    def _soften(self, plant, scene) -> None:
        """Feet and floor as stiff, as damped and as rough as this robot's."""
        inspector, body = scene.model_inspector(), self.body
        stiffness = 2 * FOOT_N_M * (NOMINAL_S / body.contact_s) ** 2
        relaxes = body.relaxes * body.contact_s / NOMINAL_S
        for index in inspector.GetAllGeometryIds(Role.kProximity):
            properties = ProximityProperties(inspector.GetProximityProperties(index))
            fresh = ProximityProperties()
            AddContactMaterial(None, stiffness, CoulombFriction(body.friction, body.friction), fresh)
            for name in ("coulomb_friction", "point_contact_stiffness"):
                properties.UpdateProperty("material", name, fresh.GetProperty("material", name))
            properties.UpdateProperty("material", "relaxation_time", relaxes)
            scene.AssignRole(plant.get_source_id(), index, properties, RoleAssign.kReplace)

    def _read(self) -> None:
        state = self.plant.GetPositionsAndVelocities(self.here)
        self.state, self.q, self.v = state, state[self.rows], state[self.columns]

    def step(self, torque: np.ndarray) -> None:
        self.torques.FixValue(self.here, torque[self.order])
        if self.pulled:
            self.forces.FixValue(self.here, self._pull())
        self.diagram.ExecuteForcedEvents(self.context)
        self._read()

    def pose(self, state: np.ndarray) -> np.ndarray:
        """(13, …) place, quaternion (w first), velocity, angular velocity in the world, of states of the plant."""
        a, m = self.at, self.plant.num_positions() + self.moves
        return np.concatenate([state[a + 4 : a + 7], state[a : a + 4], state[m + 3 : m + 6], state[m : m + 3]])

    def _pull(self) -> np.ndarray:
        body, out, pose = self.body, np.zeros(self.plant.num_velocities()), self.pose(self.state)
        place, speed = pose[:3], pose[7:10]
        m = self.moves
        if body.cable is not None:
            force, towards, damping = body.cable
            out[m + 3 : m + 6] = force * np.array([math.cos(towards), math.sin(towards), 0.0]) - damping * speed
        if body.tether is not None:
            height, stiffness, slack = body.tether
            line = np.array([0.15, 0.1, 0.15 + height]) - place
            length = float(np.linalg.norm(line))
            taut = max(0.0, length - math.hypot(height, 0.18) - slack)
            out[m + 3 : m + 6] += stiffness * taut * line / length
        if body.adhesion_n:
            for foot in self.feet:
                leg = self.plant.EvalBodyPoseInWorld(self.here, foot)
                corner = np.array(_corner(foot.name()))
                sole = np.array([*(0.12 * np.sign(corner)), 0.0])
                where = leg.multiply(sole)
                if where[2] < 0.0245:
                    jacobian = self.plant.CalcJacobianTranslationalVelocity(
                        self.here,
                        JacobianWrtVariable.kV,
                        foot.body_frame(),
                        sole,
                        self.plant.world_frame(),
                        self.plant.world_frame(),
                    )
                    out -= body.adhesion_n * jacobian[2]
        return out


def _corner(name: str) -> tuple[float, float]:
    leg = name.rsplit("_", 1)[1]
    return (1.0 if leg[0] == "f" else -1.0), (1.0 if leg[1] == "l" else -1.0)
