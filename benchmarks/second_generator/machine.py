"""Bodies: the nominal MJCF that the diagnosis gets, and the true one, an edited copy that Drake reads.

A machine is the Ant of the nominal file, sometimes with other joint names, or an arm of one or two of the same servos that
is written here. Masses, lengths and contacts of the true one differ within the tolerances of the catalogue.
"""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

import numpy as np
from answer import Answer, CannotHave, Effect

__all__ = ["Machine", "TrueBody", "ant", "arm", "truth"]

#: N/m and s of a foot's contact that sags and settles as the nominal model's (2.94 N: 5.85 mm; measured in MuJoCo)
FOOT_N_M, FOOT_RELAXES_S, NOMINAL_S = 503.0, 0.07, 0.02
HOME = {"hip": 0.0, "knee": -0.8727}
LEGS = ("rr", "fr", "fl", "rl")
#: of the catalogue, of a given robot
LINK, TORSO_KG, ARMATURE, FLOOR, CONTACT, TILT = 0.05, 0.03, 0.30, 0.15, 0.30, math.radians(0.5)


@dataclass(frozen=True)
class Servo:
    """A servo as the nominal model has it: N·m/rad, N·m, N·m·s/rad, kg·m², N·m."""

    stiffness: float
    limit: float
    damping: float
    armature: float
    friction: float


@dataclass(frozen=True)
class Machine:
    """What a diagnosis may know.

    Attributes:
        joints: in the order of the model's actuators. kinds: "hip" or "knee", one a joint: its servo.
        stands_in: joint of an answer → joint here.
        model: the text of the MJCF. walks: it has a free joint and feet.
    """

    joints: tuple[str, ...]
    kinds: tuple[str, ...]
    stands_in: dict[str, str]
    model: str
    walks: bool
    servos: dict[str, Servo]

    def at(self, joints: tuple[str, ...] | str) -> np.ndarray:
        """Columns of the joints that an answer names."""
        if isinstance(joints, str):
            return np.arange(len(self.joints))
        return np.array(sorted({self.joints.index(self.stands_in[name]) for name in joints}))


@dataclass
class TrueBody:
    """The body that is simulated: edited MJCF, and what an MJCF does not say.

    Attributes:
        armature: (n,) kg·m², all of it. pull: N, direction rad, N·s/m of a cable.
        springs: (kind, bodies or joint, figures) that Drake adds.
    """

    tree: ET.Element
    armature: np.ndarray
    friction: float
    contact_s: float
    relaxes: float
    tilt: tuple[float, float]
    blocked: dict[str, float] = field(default_factory=dict)
    cable: tuple[float, float, float] | None = None
    tether: tuple[float, float, float] | None = None
    adhesion_n: float = 0.0
    mount: tuple[str, float] | None = None
    band: tuple[str, str, float] | None = None


def _servos(root: ET.Element) -> dict[str, Servo]:
    found = {}
    for default in root.iter("default"):
        joint, position = default.find("joint"), default.find("position")
        if joint is not None and position is not None:
            found[default.get("class", "")] = Servo(
                float(position.get("kp", 0)), float(position.get("forcerange", "0 0").split()[1]),
                float(joint.get("damping", 0)), float(joint.get("armature", 0)), float(joint.get("frictionloss", 0)),
            )  # fmt: skip
    return found


def ant(answer: Answer, chance: np.random.Generator) -> Machine:
    """The nominal file's robot; four of ten have other joint names."""
    root = ET.fromstring(answer.model.read_text(encoding="utf-8"))
    names = tuple(str(one.get("joint")) for one in root.find("actuator") or ())
    style = int(chance.choice([0, 0, 0, 1, 2]))
    corner = {leg: f"{leg[0].upper()}{leg[1].upper()}" for leg in LEGS}
    new = {}
    for name in names:
        part, leg = name.split("_")
        words = {"hip": "yaw", "knee": "pitch"}[part]
        new[name] = (name, f"{corner[leg]}_{words}_joint", f"leg{LEGS.index(leg) + 1}.{words}")[style]
    if style:
        for one in root.iter():
            for key in ("joint", "name"):
                if one.tag in ("joint", "position", "jointpos", "jointvel") and one.get(key) in new:
                    one.set(key, new[str(one.get(key))])
    kinds = tuple(name.split("_")[0] for name in names)
    text = ET.tostring(root, encoding="unicode")
    return Machine(tuple(new[name] for name in names), kinds, new, text, True, _servos(root))


def arm(answer: Answer, chance: np.random.Generator) -> Machine:
    """A pendulum or an arm of two joints, on a bench: hips are played by the joint at the base, knees by the last."""
    given = _servos(ET.fromstring(answer.model.read_text(encoding="utf-8")))
    ill = {name.split("_")[0] for one in answer.effects if not isinstance(one.joints, str) for name in one.joints}
    two = bool(chance.random() < 0.6) or len(ill) > 1
    kinds = ("hip", "knee") if two else (ill.pop() if ill else str(chance.choice(["hip", "knee"])),)
    names = (("shoulder", "elbow") if two else ("pendulum",)) if chance.random() < 0.5 else ("j1", "j2")[: len(kinds)]
    vertical = two and bool(chance.random() < 0.4)
    lengths = chance.uniform(0.08, 0.16, len(kinds))
    masses = chance.uniform(0.03, 0.1, len(kinds)) / (1.0 if two else 0.5)
    defaults = "".join(
        f'<default class="{kind}"><joint damping="{s.damping:.6g}" armature="{s.armature:.6g}" frictionloss="{s.friction:.6g}"'
        f' range="{-1.6 - 0.4 * (kind == "knee"):.6g} 1.6"/><position kp="{s.stiffness:.6g}" forcerange="{-s.limit:.6g} {s.limit:.6g}"/></default>'
        for kind, s in given.items()
        if kind in kinds
    )
    body = end = ""
    for k, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        axis = "0 0 1" if vertical and k == 0 else "0 1 0"
        along = f"{lengths[k]:.4f} 0 0"
        place = "0 0 0" if k == 0 else f"{lengths[k - 1]:.4f} 0 0"
        body += (
            f'<body name="link{k + 1}" pos="{place}"><joint name="{name}" class="{kind}" axis="{axis}"/>'
            f'<geom name="rod{k + 1}" type="capsule" size="0.012" fromto="0 0 0 {along}" mass="0.03" contype="0" conaffinity="0"/>'
            f'<geom name="weight{k + 1}" type="sphere" size="0.02" pos="{along}" mass="{masses[k]:.4f}" contype="0" conaffinity="0"/>'
        )
        end += "</body>"
    drives = "".join(f'<position name="{n}" class="{k}" joint="{n}"/>' for n, k in zip(names, kinds, strict=True))
    sensors = "".join(f'<jointpos name="pos.{n}" joint="{n}"/><jointvel name="vel.{n}" joint="{n}"/>' for n in names)
    text = (
        f'<mujoco model="bench_arm"><compiler angle="radian" autolimits="true" inertiafromgeom="true"/>'
        f'<option timestep="0.001" integrator="implicitfast"/><default>{defaults}</default>'
        f'<worldbody><body name="mount" pos="0 0 0.5"><geom name="mount" type="box" size="0.02 0.02 0.02" mass="0.1" contype="0" conaffinity="0"/>'
        f"{body}{end}</body></worldbody><actuator>{drives}</actuator><sensor>{sensors}</sensor></mujoco>"
    )
    by_kind = dict(zip(kinds, names, strict=True))
    stands_in = {f"{kind}_{leg}": by_kind.get(kind, names[0]) for leg in LEGS for kind in ("hip", "knee")}
    return Machine(names, kinds, stands_in, text, False, given)


def _between(chance: np.random.Generator, tolerance: float, n: int) -> np.ndarray:
    """(n,) factors within ± tolerance, with a part that all share."""
    part = float(chance.uniform(0.2, 0.8))
    return 1 + tolerance * (part * chance.uniform(-1, 1) + (1 - part) * chance.uniform(-1, 1, n))


def _scale_mass(tree: ET.Element, factor: dict[str, float]) -> None:
    for geom in tree.iter("geom"):
        name = str(geom.get("name"))
        if name in factor:
            geom.set("mass", f"{float(geom.get('mass', 0)) * factor[name]:.6g}")


def _moved(machine: Machine, column: int) -> list[str]:
    """Geoms that move with a joint and belong to its own link."""
    name, kind = machine.joints[column], machine.kinds[column]
    if not machine.walks:
        return [f"rod{column + 1}", f"weight{column + 1}"]
    old = next(given for given, new in machine.stands_in.items() if new == name)
    return [("upper_" if kind == "hip" else "lower_") + old.split("_")[1]]


def truth(machine: Machine, answer: Answer, chance: np.random.Generator) -> TrueBody:
    """The body of one robot: healthy scatter, then what is wrong with it."""
    n = len(machine.joints)
    tree = copy.deepcopy(ET.fromstring(machine.model))
    armature = np.array([machine.servos[kind].armature for kind in machine.kinds]) * _between(chance, ARMATURE, n)
    links = _between(chance, LINK, n)
    factor = {geom: float(links[k]) for k in range(n) for geom in _moved(machine, k)}
    factor |= {f"root_{leg}": float(f) for leg, f in zip(LEGS, _between(chance, LINK, 4), strict=True)}
    _scale_mass(tree, factor)
    body = TrueBody(
        tree, armature, 0.6 * float(_between(chance, FLOOR, 1)[0]), NOMINAL_S * float(_between(chance, CONTACT, 1)[0]),
        FOOT_RELAXES_S * float(np.exp(chance.uniform(-0.5, 0.3))),
        (float(chance.uniform(0, TILT)) if machine.walks else 0.0, float(chance.uniform(-math.pi, math.pi))),
    )  # fmt: skip
    if machine.walks:
        torso = _geom(tree, "torso")
        torso.set("mass", f"{float(torso.get('mass', 0)) + chance.uniform(-TORSO_KG, TORSO_KG):.6g}")
        for leg in LEGS:
            _stretch(tree, leg, "lower", 1 + float(chance.uniform(-0.008, 0.008)))
    for effect in answer.effects:
        _apply(machine, body, effect)
    if answer.outside:
        _apply_outside(machine, body, answer)
    return body


def _geom(tree: ET.Element, name: str) -> ET.Element:
    return next(one for one in tree.iter("geom") if one.get("name") == name)


def _body(tree: ET.Element, name: str) -> ET.Element:
    return next(one for one in tree.iter("body") if one.get("name") == name)


def _stretch(tree: ET.Element, leg: str, part: str, factor: float) -> None:
    geom = _geom(tree, f"{part}_{leg}")
    geom.set("fromto", " ".join(f"{factor * float(x):.6g}" for x in str(geom.get("fromto")).split()))


def _apply(machine: Machine, body: TrueBody, effect: Effect) -> None:
    at, p = machine.at(effect.joints), effect.parameters
    match effect.name:
        case "armature_error":
            body.armature[at] *= p["kg_m2"] / float(np.mean(body.armature[at]))
        case "link_mass":
            _scale_mass(body.tree, {geom: p["scale"] for k in at for geom in _moved(machine, k)})
        case "blocked_joint":
            body.blocked |= {machine.joints[k]: p["angle_rad"] for k in at}
        case "payload":
            x, y, z = p["position_m"]
            where = "torso"
            if not machine.walks:
                where = f"link{len(machine.joints)}"
                x, y, z = (float(v) for v in str(_geom(body.tree, f"weight{len(machine.joints)}").get("pos")).split())
            ET.SubElement(
                _body(body.tree, where), "geom", name="payload", type="box", size="0.015 0.015 0.015",
                pos=f"{x:.5f} {y:.5f} {z:.5f}", mass=f"{p['mass_kg']:.5f}", contype="0", conaffinity="0",
            )  # fmt: skip
        case name if not machine.walks and name in _GROUND:
            raise CannotHave(f"an arm on a bench has no {name}")
        case "floor_friction":
            body.friction = p["sliding"]
        case "contact_softness":
            body.contact_s = p["time_constant_s"]
        case "foot_adhesion":
            body.adhesion_n = p["force_n"]
        case "floor_tilt":
            body.tilt = (p["angle_rad"], p["direction"])
        case "cable_drag":
            body.cable = (p["force_n"], p["direction"], p["damping_n_s_m"])
        case _:
            pass  # of servos, clocks or sensors


_GROUND = (
    "floor_friction", "contact_softness", "foot_adhesion", "floor_tilt", "cable_drag", "imu_misalignment", "imu_bias",
    "tracker_scale",
)  # fmt: skip


def _apply_outside(machine: Machine, body: TrueBody, answer: Answer) -> None:
    name, strength, tree = answer.outside, float(answer.parameters["strength"]), body.tree
    if name not in _OF_BODIES:
        return
    if not machine.walks:
        raise CannotHave(f"an arm on a bench has no {name}")
    leg = str(answer.parameters["joint"]).split("_")[1]
    match name:
        case "long_leg" | "lost_foot":
            factor = 1 + 0.22 * strength if name == "long_leg" else 1 - 0.2 * strength
            _stretch(tree, leg, "lower", factor)
            _scale_mass(tree, {f"lower_{leg}": factor})
        case "loose_battery":
            battery = ET.SubElement(_body(tree, "torso"), "body", name="battery", pos="0 0 0.02")
            ET.SubElement(
                battery, "joint", name="battery", type="slide", axis="0 1 0", range="-0.04 0.04", damping="0.08"
            )
            ET.SubElement(
                battery, "geom", type="box", size="0.02 0.015 0.01", mass=f"{0.2 * strength:.4f}", contype="0",
                conaffinity="0",
            )  # fmt: skip
        case "mount_resonance":
            x, y = (float(v) for v in str(_body(tree, f"upper_leg_{leg}").get("pos")).split()[:2])
            joint = ET.Element("joint", name="mount", type="hinge", axis=f"{-y:.4f} {x:.4f} 0", damping="0.02")
            # The legs' roots meet in the torso: what turns there must not touch them.
            for key in ("contype", "conaffinity"):
                _geom(tree, f"root_{leg}").set(key, "0")
            _body(tree, f"leg_{leg}").insert(0, joint)
            body.mount = ("mount", 8.0 / strength)
        case "rubber_band":
            other = LEGS[(LEGS.index(leg) + 1) % 4]
            body.band = (f"lower_leg_{leg}", f"lower_leg_{other}", 6.0 * strength)
        case "uneven_floor":
            x, y = (math.copysign(0.2, float(v)) for v in str(_body(tree, f"upper_leg_{leg}").get("pos")).split()[:2])
            world = tree.find("worldbody")
            assert world is not None
            ET.SubElement(
                world, "geom", name="slab", type="box", size="0.06 0.06 0.05",
                pos=f"{x:.3f} {y:.3f} {0.015 * strength - 0.05:.4f}",
            )  # fmt: skip
        case "tether":
            # A line to a hook above, with 2 mm to spare: it pulls only once it is taut.
            body.tether = (0.4 * strength, 150.0 * strength, 0.002 * strength)


_OF_BODIES = (
    "long_leg", "lost_foot", "loose_battery", "mount_resonance", "rubber_band", "uneven_floor", "tether",
)  # fmt: skip
