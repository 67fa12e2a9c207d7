"""One robot of the batch simulator in numbers: the data sheet, its scatter within tolerance, and what is wrong with it.

Own code on purpose: only the names and parameters of the effects are the catalogue's. Every scatter is the mean of a part
that all joints share and one of each joint, both even within the tolerance of the catalogue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.blind.draw import Answer, Drawn
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit

__all__ = ["Clocks", "Mechanics", "Senses", "Servos", "TrueRobot", "true_robot"]

Array = NDArray[np.float64]

#: N·m, friction of a healthy joint in the nominal model
COULOMB_NM = 0.05
#: of the catalogue: tolerance of stiffness and torque limit, of damping, armature, links, floor friction, contact time
STIFFNESS, DAMPING, ARMATURE, LINK, FLOOR, CONTACT = 0.15, 0.25, 0.30, 0.05, 0.15, 0.30
FRICTION_NM, ZERO_RAD, TORSO_KG, DELAY_S = 0.02, math.radians(0.5), 0.03, 2e-3
#: of a servo's inertia that turns with the output, behind the last gap of the gear
OUTPUT_SHARE = 0.08
TILT_RAD, MOUNT_RAD, GYRO_RAD_S, ACC_M_S2 = math.radians(0.5), math.radians(1.0), 0.01, 0.1


@dataclass
class Servos:
    """Loops, motors, gears of eight joints, (8,) each, SI at the output; see `simulate` for how they act.

    Attributes:
        p_gain: PWM counts per pulse of error. i_gain: the same per pulse and control period.
        kt, ke, resistance: N·m/A, V·s/rad, Ω. viscous, quadratic: N·m·s/rad, N·m·s²/rad².
        fall: N·m lost per rad/s by the torque that can be had; a bound on torque only.
        coulomb, static: N·m kinetic and static; positive, negative: what either direction has more, N·m.
        bristle_rad: deflection at which LuGre's bristles slide.
    """

    p_gain: Array
    i_gain: Array
    kt: Array
    ke: Array
    resistance: Array
    viscous: Array
    quadratic: Array
    fall: Array
    torque_limit: Array
    strength: Array
    coulomb: Array
    static: Array
    stribeck: Array
    positive: Array
    negative: Array
    load_friction: Array
    bristle_rad: Array
    rotor: Array
    gear_stiffness: Array
    gear_damping: Array
    gap: Array
    cogging: Array
    periods: Array
    dead_zone: Array
    derating: Array
    derating_s: Array
    zero: Array
    slip_nm: Array
    chipped: Array
    runout: Array
    supply_v: float = 12.0
    supply_ohm: float = 0.02


@dataclass
class Mechanics:
    """Masses, lengths, contacts and surroundings.

    Attributes:
        link_scale: (8,) of the link that each joint moves. lengths: (4, 3) factors of root, upper and lower leg.
        output_armature: (8,) kg·m² that is left at the joint, in front of the gear.
        friction, contact_s, contact_damping, solimp: of the floor.
    """

    link_scale: Array
    output_armature: Array
    lengths: Array
    torso_kg: float
    friction: float
    contact_s: float
    contact_damping: float
    solimp: tuple[float, float, float]
    pyramidal: bool
    impratio: float
    integrator: str
    gravity: Array
    cable: tuple[Array, float, float, Array] | None = None
    adhesion_n: float = 0.0
    payloads: list[tuple[float, Array]] = field(default_factory=list)
    blocked: dict[str, float] = field(default_factory=dict)
    outside: str | None = None
    outside_joint: str = ""
    outside_strength: float = 1.0


@dataclass
class Clocks:
    """When what happens, s.

    Attributes:
        row_s: scatter of the rows about their rate. stamp_s: error of a row's stamp.
        gap_s: from a row to its command; gap_scatter_s of it. base_s: from the command's last byte to its effect.
        delay, lag, slew, jitter, lost, longest: (8,) of the commands.
        sensor_s: by how much joints' answers are old; imu_s: the IMU's.
    """

    row_s: float
    stamp_s: float
    gap_s: float
    gap_scatter_s: float
    base_s: float
    sense_s: float
    delay: Array
    lag: Array
    slew: Array
    jitter: float
    lost: Array
    longest: Array
    sensor_s: float = 0.0
    imu_s: float = 2e-3
    ppm: float = 0.0


@dataclass
class Senses:
    """What sensors add: noise as standard deviations, mounting, bias."""

    encoder_rad: float
    current_a: float
    gyro_noise: float
    acc_noise: float
    mount_rad: Array
    gyro_bias: Array
    acc_bias: Array
    tracker_m: float
    tracker_rad: float
    tracker_scale: float = 1.0
    tracker_yaw: float = 0.0
    tracker_s: float = 0.0


@dataclass
class TrueRobot:
    """All of it; `temperature_c` is the case's at the start of each run."""

    servos: Servos
    mechanics: Mechanics
    clocks: Clocks
    senses: Senses
    ambient_c: float
    warming_k: float
    seed: int
    tracker: bool


def true_robot(answer: Answer) -> TrueRobot:
    """The robot that an answer describes; the same for the same answer."""
    chance = np.random.default_rng(answer.seed)
    servos, mechanics = _servos(chance), _mechanics(chance)
    clocks = Clocks(
        row_s=float(chance.uniform(5e-5, 6e-4)), stamp_s=float(chance.uniform(2e-5, 3e-4)),
        gap_s=float(chance.uniform(1e-3, 3e-3)), gap_scatter_s=float(chance.uniform(2e-5, 3e-4)),
        base_s=float(chance.uniform(0.0, 0.9 * DELAY_S)), sense_s=float(chance.uniform(0.0, 5e-4)),
        delay=np.zeros(8), lag=np.zeros(8), slew=np.full(8, np.inf), jitter=0.0, lost=np.zeros(8), longest=np.zeros(8),
        imu_s=float(chance.uniform(5e-4, 3e-3)), ppm=float(chance.uniform(-40, 40)),
    )  # fmt: skip
    senses = Senses(
        encoder_rad=float(chance.uniform(1e-4, 4e-4)), current_a=float(chance.uniform(2e-3, 8e-3)),
        gyro_noise=float(chance.uniform(2e-3, 6e-3)), acc_noise=float(chance.uniform(0.02, 0.08)),
        mount_rad=_within(chance, MOUNT_RAD / math.sqrt(3), 3), gyro_bias=_within(chance, GYRO_RAD_S / math.sqrt(3), 3),
        acc_bias=_within(chance, ACC_M_S2 / math.sqrt(3), 3), tracker_m=float(chance.uniform(5e-4, 2.5e-3)),
        tracker_rad=float(chance.uniform(2e-3, 8e-3)),
    )  # fmt: skip
    robot = TrueRobot(
        servos, mechanics, clocks, senses, float(chance.uniform(20, 26)), float(chance.uniform(14, 24)), answer.seed,
        answer.tracker,
    )  # fmt: skip
    for drawn in answer.effects:
        _apply(robot, drawn)
    if answer.outside:
        _apply_outside(robot, answer)
    _finish(servos, mechanics)
    return robot


def _within(chance: np.random.Generator, tolerance: float, n: int) -> Array:
    return chance.uniform(-tolerance, tolerance, n)


def _scatter(chance: np.random.Generator, tolerance: float) -> Array:
    """(8,) within ± tolerance, half of it common to all joints."""
    return (chance.uniform(-tolerance, tolerance) + chance.uniform(-tolerance, tolerance, 8)) / 2


def _servos(chance: np.random.Generator) -> Servos:
    parts = kit("standard")
    models = [parts.servo(joint.kind) for joint in JOINTS.values()]

    def column(values: Sequence[float]) -> Array:
        return np.array(values, float)

    kt = column([model.kt_nm_a for model in models]) * (1 + _scatter(chance, 0.6 * STIFFNESS))
    damping = column([model.electrical_damping_nm_s_rad for model in models]) * (1 + _scatter(chance, DAMPING))
    resistance = column([model.resistance_ohm for model in models])
    # The nominal model has all damping in the joint; what of it is electrical stays well within the damping's tolerance.
    share = float(chance.uniform(0.0, 0.12))
    gain = column(
        [float(model.register("position_p_gain").default or 0) / model.position_p_divisor for model in models]
    )
    coulomb = COULOMB_NM + _scatter(chance, FRICTION_NM)
    armature = column([model.armature_kg_m2 for model in models]) * (1 + _scatter(chance, ARMATURE))
    zeros = np.zeros(8)
    return Servos(
        p_gain=gain * (1 + _scatter(chance, 0.4 * STIFFNESS)), i_gain=zeros.copy(), kt=kt,
        ke=share * damping * resistance / kt, resistance=resistance, viscous=(1 - share) * damping,
        quadratic=zeros.copy(), fall=zeros.copy(), torque_limit=np.full(8, np.inf), strength=np.ones(8),
        coulomb=coulomb, static=coulomb * chance.uniform(1.0, 1.2), stribeck=np.full(8, 0.08), positive=zeros.copy(),
        negative=zeros.copy(), load_friction=zeros.copy(), bristle_rad=chance.uniform(2e-4, 8e-4, 8), rotor=armature,
        gear_stiffness=chance.uniform(250.0, 450.0, 8), gear_damping=zeros.copy(), gap=chance.uniform(0.0, 1e-3, 8),
        cogging=zeros.copy(), periods=zeros.copy(), dead_zone=zeros.copy(), derating=zeros.copy(), derating_s=zeros.copy(),
        zero=_scatter(chance, ZERO_RAD), slip_nm=np.full(8, np.inf), chipped=zeros.copy(), runout=zeros.copy(),
        supply_v=float(chance.uniform(11.9, 12.1)), supply_ohm=float(chance.uniform(0.0, 0.04)),
    )  # fmt: skip


def _mechanics(chance: np.random.Generator) -> Mechanics:
    pyramidal = bool(chance.random() < 0.15)
    tilt, towards = float(chance.uniform(0, TILT_RAD)), float(chance.uniform(-math.pi, math.pi))
    return Mechanics(
        link_scale=1 + _scatter(chance, LINK), output_armature=np.zeros(8), lengths=1 + chance.uniform(-0.01, 0.01, (4, 3)),
        torso_kg=float(chance.uniform(-TORSO_KG, TORSO_KG)), friction=0.6 * (1 + float(chance.uniform(-FLOOR, FLOOR))),
        contact_s=0.02 * (1 + float(chance.uniform(-CONTACT, CONTACT))), contact_damping=float(chance.uniform(1.1, 1.6)),
        solimp=(float(chance.uniform(0.65, 0.85)), float(chance.uniform(0.88, 0.96)), float(chance.uniform(0.01, 0.025))),
        pyramidal=pyramidal,
        impratio=float(np.exp(chance.uniform(0.0, math.log(4.0 if pyramidal else 30.0)))),
        integrator=str(chance.choice(["euler", "implicit"])), gravity=_gravity(tilt, towards),
    )  # fmt: skip


def _gravity(tilt: float, towards: float) -> Array:
    across = 9.81 * math.sin(tilt)
    return np.array([across * math.cos(towards), across * math.sin(towards), -9.81 * math.cos(tilt)])


def _finish(servos: Servos, mechanics: Mechanics) -> None:
    """Part the inertia between rotor and output, and damp the teeth."""
    mechanics.output_armature = OUTPUT_SHARE * servos.rotor
    servos.rotor = servos.rotor - mechanics.output_armature
    # A quarter of the critical damping of the lighter side, about a leg's inertia.
    servos.gear_damping = 0.5 * np.sqrt(servos.gear_stiffness * 2e-3)


def _columns(joints: tuple[str, ...] | str) -> NDArray[np.int64]:
    names = list(JOINTS)
    return np.array([names.index(name) for name in (names if isinstance(joints, str) else joints)])


def _apply(robot: TrueRobot, drawn: Drawn) -> None:
    at, p = _columns(drawn.joints), drawn.parameters
    s, m, c = robot.servos, robot.mechanics, robot.clocks
    match drawn.effect:
        case "action_delay":
            c.delay[at] += p["delay_s"]
        case "actuator_lag":
            c.lag[at] = p["time_constant_s"]
        case "slew_limit":
            c.slew[at] = p["rate_rad_s"]
        case "sensor_delay":
            if drawn.joints == "body":
                c.imu_s += p["delay_s"]
            else:
                c.sensor_s = p["delay_s"]
        case "clock_jitter":
            c.jitter = p["std_s"]
        case "command_dropout":
            c.lost[at], c.longest[at] = p["fraction"], p["longest_s"]
        case "stiffness_error":
            s.p_gain[at] *= p["scale"]
        case "damping_error":
            s.viscous[at] *= p["scale"]
            s.ke[at] *= p["scale"]
        case "electrical_damping":
            total = s.viscous[at] + s.kt[at] * s.ke[at] / s.resistance[at]
            s.ke[at] = p["share"] * total * s.resistance[at] / s.kt[at]
            s.viscous[at] = (1 - p["share"]) * total
        case "weak_joint":
            s.strength[at] *= p["scale"]
        case "coulomb_friction":
            s.static[at] *= p["torque_nm"] / s.coulomb[at]
            s.coulomb[at] = p["torque_nm"]
        case "stribeck_friction":
            s.coulomb[at], s.static[at], s.stribeck[at] = p["coulomb_nm"], p["static_nm"], p["velocity_rad_s"]
        case "load_friction":
            s.load_friction[at] = p["coefficient"]
        case "asymmetric_friction":
            s.coulomb[at] = s.static[at] = 0.0
            s.positive[at], s.negative[at] = p["positive_nm"], p["negative_nm"]
        case "viscous_nonlinear":
            s.quadratic[at] = p["coefficients"]
        case "torque_limit":
            s.torque_limit[at] = p["torque_nm"]
        case "speed_limit":
            s.fall[at] = 1 / p["no_load_rad_s"]
        case "voltage_sag":
            s.supply_ohm = p["resistance_ohm"]
        case "thermal_derating":
            s.derating[at], s.derating_s[at] = p["loss_per_c"], p["time_constant_s"]
        case "backlash":
            s.gap[at] = p["gap_rad"]
        case "joint_compliance":
            s.gear_stiffness[at] = p["stiffness_nm_rad"]
        case "cogging":
            s.cogging[at], s.periods[at] = p["amplitude_nm"], p["periods"]
        case "dead_zone":
            s.dead_zone[at] = p["width_rad"]
        case "armature_error":
            s.rotor[at] *= p["kg_m2"] / float(np.mean(s.rotor[at]))
        case "link_mass":
            m.link_scale[at] *= p["scale"]
        case "zero_offset":
            s.zero[at] += p["angle_rad"]
        case "blocked_joint":
            for name in drawn.joints:
                m.blocked[name] = p["angle_rad"]
        case _:
            _apply_to_body(robot, drawn.effect, p)


def _apply_to_body(robot: TrueRobot, effect: str, p: Any) -> None:
    m, senses = robot.mechanics, robot.senses
    match effect:
        case "payload":
            m.payloads.append((p["mass_kg"], np.asarray(p["position_m"])))
        case "floor_friction":
            m.friction = p["sliding"]
        case "contact_softness":
            m.contact_s = p["time_constant_s"]
        case "foot_adhesion":
            m.adhesion_n = p["force_n"]
        case "floor_tilt":
            m.gravity = _gravity(p["angle_rad"], p["direction"])
        case "cable_drag":
            force = p["force_n"] * np.array([math.cos(p["direction"]), math.sin(p["direction"]), 0.0])
            m.cable = (
                force,
                p["damping_n_s_m"],
                p.get("stiffness_n_m", 0.0),
                np.asarray(p.get("anchor_m", np.zeros(3))),
            )
        case "imu_misalignment":
            senses.mount_rad = np.asarray(p["rotation_rad"])
        case "imu_bias":
            senses.gyro_bias, senses.acc_bias = np.asarray(p["rad_s"]), np.asarray(p["m_s2"])
        case "tracker_scale":
            senses.tracker_scale, senses.tracker_yaw, senses.tracker_s = p["scale"], p["yaw_rad"], p["latency_s"]
        case _:
            raise KeyError(f"no robot can have {effect}")


def _apply_outside(robot: TrueRobot, answer: Answer) -> None:
    s, m = robot.servos, robot.mechanics
    joint, strength = str(answer.parameters["joint"]), float(answer.parameters["strength"])
    k = list(JOINTS).index(joint)
    match answer.outside:
        case "slipping_horn":
            # A foot's share of the weight loads a knee with some 0.25 N·m, scrubbing a hip with as much.
            s.slip_nm[k] = (0.10 if joint.startswith("hip") else 0.16) / strength
        case "chipped_tooth":
            s.chipped[k] = 0.6 * strength
        case "forgotten_integral":
            s.i_gain[:] = 0.012 * strength * s.p_gain
        case "eccentric_encoder":
            s.runout[k] = 0.12 * strength
        case _:
            m.outside, m.outside_joint, m.outside_strength = answer.outside, joint, strength
