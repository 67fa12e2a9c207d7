"""The nominal MJCF of an Open Ant, written from one description, for floor and stand alike.

Names and order of joints, actuators, sensors and sites are those of the platform's own model, so that its code loads
this one. Lengths and contact softness are the platform's; what that model has wrong is put right, each with its reason
as a comment in the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from textwrap import indent

from openant_tools.robot.joints import JOINTS, LEGS, Joint, Kind, Leg
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, HOME_RAD, PLATFORM_PWM_LIMIT, Kit
from openant_tools.robot.kit import kit as kit_by_name

__all__ = ["nominal_mjcf", "nominal_model_path"]

ASSETS = Path(__file__).parent / "assets"

# Geometry of the platform's model, m.
TORSO_RADIUS = 0.075
LEG_RADIUS = 0.024
#: From one joint to the next along x and along y; a lower leg is twice as long.
SEGMENT = 0.06
STAND_HEIGHT = 0.4
#: Where the torso's centre comes to rest when it is put on its feet at the home angles.
HOME_HEIGHT = 0.148

#: N·m on every joint, the platform's figure.
FRICTIONLOSS_NM = 0.05
#: Sliding, torsional, rolling; with condim 3 only the first acts.
FLOOR_FRICTION = (0.6, 0.03, 0.05)
SOLREF = (0.02, 1.5)
SOLIMP = (0.7, 0.9, 0.02)
IMPRATIO = 10


def _n(*values: float) -> str:
    # Adding 0 turns −0 into 0.
    return " ".join(f"{value + 0:.6g}" for value in values)  # for a file


def _look_from(x: float, y: float, z: float) -> str:
    """Position and axes of a camera that looks from there at the origin with the horizon level."""
    across, distance = math.hypot(x, y), math.hypot(x, y, z)
    right = (-y / across, x / across, 0.0)
    up = (-x * z / (across * distance), -y * z / (across * distance), across / distance)
    return f'pos="{_n(x, y, z)}" xyaxes="{_n(*right, *up)}"'


def _joint(joint: Joint) -> str:
    return f'<joint name="{joint.name}" class="{joint.kind}" axis="{_n(*joint.axis)}"/>'


def _leg(leg: Leg, kit: Kit) -> str:
    hip, knee = JOINTS[f"hip_{leg.name}"], JOINTS[f"knee_{leg.name}"]
    step = (SEGMENT * leg.x_sign, SEGMENT * leg.y_sign, 0)
    foot = (2 * step[0], 2 * step[1], 0)
    across = tuple(LEG_RADIUS * 1.15 * component / 2**0.5 for component in knee.axis)
    return f"""\
<!-- {leg.words} -->
<body name="leg_{leg.name}">
  <geom name="root_{leg.name}" class="link" fromto="0 0 0 {_n(*step)}" mass="{_n(kit.leg_root_mass_kg)}"/>
  <geom class="servo" pos="{_n(*step)}" size="0.027 0.019"/>
  <body name="upper_leg_{leg.name}" pos="{_n(*step)}">
    {_joint(hip)}
    <geom name="upper_{leg.name}" class="link" fromto="0 0 0 {_n(*step)}" mass="{_n(kit.upper_leg_mass_kg)}"/>
    <geom class="servo" fromto="{_n(*(s - a for s, a in zip(step, across, strict=True)))} \
{_n(*(s + a for s, a in zip(step, across, strict=True)))}" size="0.0255"/>
    <body name="lower_leg_{leg.name}" pos="{_n(*step)}">
      {_joint(knee)}
      <geom name="lower_{leg.name}" class="shin" fromto="0 0 0 {_n(*foot)}" mass="{_n(kit.lower_leg_mass_kg)}"/>
      <geom class="rubber" pos="{_n(*foot)}" size="{_n(LEG_RADIUS * 1.04)}"/>
    </body>
  </body>
</body>
"""


def _actuator_default(kind: Kind, kit: Kit) -> str:
    servo = kit.servo(kind)
    force = servo.stall_torque_at(kit.supply_v, PLATFORM_PWM_LIMIT)
    limit = ANGLE_LIMIT_RAD[kind]
    gain = servo.register("position_p_gain").default
    derivative = servo.derivative_damping_nm_s_rad(None, kit.supply_v)
    kv = f' kv="{_n(derivative)}"' if derivative else ""
    return f"""\
<!-- {servo.name} at {_n(kit.supply_v)} V: stall {_n(servo.stall_torque_at(kit.supply_v))} N·m, P gain {gain} -->
<default class="{kind}">
  <joint range="{_n(-limit, limit)}" damping="{_n(servo.electrical_damping_nm_s_rad)}" \
armature="{_n(servo.armature_kg_m2)}" frictionloss="{_n(FRICTIONLOSS_NM)}"/>
  <position kp="{_n(servo.stiffness_nm_rad(None, kit.supply_v))}"{kv} forcerange="{_n(-force, force)}"/>
</default>
"""


def _sensors() -> Iterator[str]:
    yield '<gyro name="gyro" site="imu_location"/>'
    yield '<accelerometer name="accelerometer" site="imu_location"/>'
    yield '<framezaxis name="upvector" objtype="site" objname="imu_location"/>'
    yield "<!-- What the encoders measure, behind the platform's own sensors. -->"
    for name in JOINTS:
        yield f'<jointpos name="pos.{name}" joint="{name}"/>'
    for name in JOINTS:
        yield f'<jointvel name="vel.{name}" joint="{name}"/>'


def _lines(lines: Iterator[str] | list[str], spaces: int) -> str:
    return indent("\n".join(lines), " " * spaces)


def nominal_mjcf(kit: str = "standard") -> str:
    """The MJCF of an Open Ant as its data sheets promise it, before any measurement.

    Args:
        kit: "standard" or "lite"; BadInput for any other.
    """
    parts = kit_by_name(kit)
    home = [HOME_RAD[joint.kind] for joint in JOINTS.values()]
    classes = indent(_actuator_default("hip", parts) + _actuator_default("knee", parts), " " * 4).rstrip()
    legs = indent("".join(_leg(leg, parts) for leg in LEGS), " " * 6).rstrip()
    actuators = [
        f'<position name="{joint.name}" class="{joint.kind}" joint="{joint.name}"/>' for joint in JOINTS.values()
    ]
    excludes = [f'<exclude body1="torso" body2="upper_leg_{leg.name}"/>' for leg in LEGS]
    excludes += [f'<exclude body1="leg_{leg.name}" body2="upper_leg_{leg.name}"/>' for leg in LEGS]
    return f"""\
<!-- {parts.words}. Nominal model, written by openant_tools.robot.mjcf: change it there, not here.
     Units: m, kg, s, rad, N·m. One file for the floor and for the stand (there the free joint goes and the torso stays
     where it is below). -->
<mujoco model="open_ant_{parts.name}">
  <compiler angle="radian" autolimits="true" inertiafromgeom="true"/>
  <!-- The platform's code takes the step to be 1 ms. Elliptic cones with a high impratio: in a pyramidal cone the
       loaded feet of a standing robot creep by centimetres. -->
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="{IMPRATIO}"/>
  <statistic center="0 0 0.12" extent="0.6"/>

  <visual>
    <global offwidth="1280" offheight="960"/>
    <quality shadowsize="4096" offsamples="8"/>
    <headlight ambient="0.35 0.35 0.37" diffuse="0.35 0.35 0.35" specular="0.1 0.1 0.1"/>
    <map znear="0.02" zfar="60" shadowclip="3.5" fogstart="6" fogend="18"/>
    <rgba haze="0.86 0.89 0.93 1"/>
  </visual>

  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.93 0.95 0.98" rgb2="0.62 0.72 0.84" width="256" \
height="1536"/>
    <texture name="tiles" type="2d" builtin="checker" mark="edge" rgb1="0.80 0.82 0.84" rgb2="0.74 0.77 0.80" \
markrgb="0.90 0.91 0.92" width="512" height="512"/>
    <material name="floor" texture="tiles" texrepeat="5 5" texuniform="true"/>
    <material name="shell" rgba="0.16 0.19 0.23 1" specular="0.5" shininess="0.6"/>
    <material name="link" rgba="0.94 0.94 0.92 1" specular="0.3" shininess="0.4"/>
    <material name="shin" rgba="0.90 0.37 0.08 1" specular="0.3" shininess="0.4"/>
    <material name="servo" rgba="0.12 0.13 0.15 1" specular="0.4" shininess="0.5"/>
    <material name="rubber" rgba="0.08 0.08 0.09 1" specular="0.05" shininess="0.1"/>
  </asset>

  <default>
    <!-- Friction stands on the eight joints alone: as a default it would also hold back the free joint.
         Damping is what the motors' back-EMF brakes, stall torque over free speed. It is counted once, in the joint,
         not in the actuator: force range clips whatever is in that, so that with the damping inside a saturated servo
         would not slow down towards its speed limit. (A servo without torque brakes less than this.) An actuator's kv
         is what the factory's D gain adds where it is not 0; duty, and so force range, does clip that.
         Force range is what the platform's PWM limit of {_n(100 * PLATFORM_PWM_LIMIT)} % leaves of the stall torque.
         kp is the factory's P gain in N·m/rad. Armature is an estimate: gear ratio² times a rotor of 1e-7 kg·m². -->
{classes}
    <default class="link">
      <geom type="capsule" size="{_n(LEG_RADIUS)}" friction="{_n(*FLOOR_FRICTION)}" solref="{_n(*SOLREF)}" \
solimp="{_n(*SOLIMP)}" material="link"/>
      <default class="shin">
        <geom material="shin"/>
      </default>
    </default>
    <default class="visual">
      <geom contype="0" conaffinity="0" mass="0" group="1"/>
      <default class="servo">
        <geom type="cylinder" material="servo"/>
      </default>
      <default class="rubber">
        <geom type="sphere" material="rubber"/>
      </default>
    </default>
  </default>

  <worldbody>
    <!-- MuJoCo takes the larger friction of two geoms, so that a floor more slippery than the feet would change
         nothing. Priority lets the floor's friction and softness decide. -->
    <geom name="floor" type="plane" size="40 40 1" material="floor" priority="1" condim="3" \
friction="{_n(*FLOOR_FRICTION)}" solref="{_n(*SOLREF)}" solimp="{_n(*SOLIMP)}"/>
    <body name="torso" pos="0 0 {_n(STAND_HEIGHT)}">
      <freejoint name="root"/>
      <!-- The light walks along: shadows are drawn on a patch of floor around the point it looks at. -->
      <light name="sun" mode="trackcom" directional="true" pos="-0.3 -0.5 1.5" dir="0.3 0.5 -1.5" \
diffuse="0.6 0.59 0.57" specular="0.25 0.25 0.25"/>
      <camera name="track" mode="trackcom" {_look_from(0.0, -1.0, 0.42)}/>
      <camera name="portrait" mode="trackcom" {_look_from(0.66, -0.16, 0.33)}/>
      <site name="imu_location" size="0.005" rgba="0 0 0 0"/>
      <site name="eye_left" pos="0.05 0.03 0.02" size="0.02" rgba="1 1 1 1"/>
      <site name="eye_right" pos="0.05 -0.03 0.02" size="0.02" rgba="1 1 1 1"/>
      <site name="pupil_left" pos="0.06 0.03 0.02" size="0.013" rgba="0.05 0.05 0.06 1"/>
      <site name="pupil_right" pos="0.06 -0.03 0.02" size="0.013" rgba="0.05 0.05 0.06 1"/>
      <geom name="torso" type="sphere" size="{_n(TORSO_RADIUS)}" mass="{_n(parts.torso_mass_kg)}" material="shell" \
friction="{_n(*FLOOR_FRICTION)}" solref="{_n(*SOLREF)}" solimp="{_n(*SOLIMP)}"/>
{legs}
    </body>
  </worldbody>

  <contact>
    <!-- MuJoCo lets no body touch its parent unless that is the world. On the stand the torso is part of the world, so
         the hips would meet what they are screwed to: say it for both setups. -->
{_lines(excludes, 4)}
  </contact>

  <actuator>
{_lines(actuators, 4)}
  </actuator>

  <sensor>
{_lines(_sensors(), 4)}
  </sensor>

  <keyframe>
    <key name="home" qpos="{_n(0, 0, HOME_HEIGHT, 1, 0, 0, 0, *home)}" ctrl="{_n(*home)}"/>
  </keyframe>
</mujoco>
"""


def nominal_model_path(kit: str = "standard") -> Path:
    """The file in this package that holds `nominal_mjcf(kit)`."""
    return ASSETS / f"ant_{kit_by_name(kit).name}.xml"


def write_assets() -> None:
    """Write both kits' models into the package; run after every change here (`python -m openant_tools.robot.mjcf`)."""
    ASSETS.mkdir(exist_ok=True)
    for name in ("standard", "lite"):
        nominal_model_path(name).write_text(nominal_mjcf(name), encoding="utf-8")


if __name__ == "__main__":
    write_assets()
