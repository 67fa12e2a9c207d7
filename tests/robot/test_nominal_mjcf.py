"""The nominal model: loads in plain MuJoCo, carries the platform's names, stands, and keeps its known faults out."""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np
import pytest

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.kit import KITS, home_angles
from openant_tools.robot.mjcf import nominal_mjcf, nominal_model_path

every_kit = pytest.mark.parametrize("kit", list(KITS))


def load(kit: str) -> Any:
    return mujoco.MjModel.from_xml_path(str(nominal_model_path(kit)))


def on_the_stand(kit: str) -> Any:
    """Formats, section 1: the free joint is removed, and there is nothing below the torso."""
    spec = mujoco.MjSpec.from_file(str(nominal_model_path(kit)))
    spec.delete(spec.joint("root"))
    spec.delete(spec.geom("floor"))
    spec.delete(spec.key("home"))
    return spec.compile()


@every_kit
def test_the_file_in_the_package_is_what_the_generator_writes(kit: str) -> None:
    assert nominal_model_path(kit).read_text(encoding="utf-8") == nominal_mjcf(kit), (
        "run `python -m openant_tools.robot.mjcf`"
    )


def test_an_unknown_kit_is_named() -> None:
    with pytest.raises(BadInput, match="there is no kit 'heavy' → use standard or lite"):
        nominal_mjcf("heavy")


@every_kit
def test_names_and_order_are_the_platforms(kit: str) -> None:
    model = load(kit)
    assert [model.joint(k).name for k in range(1, model.njnt)] == list(JOINT_NAMES)
    assert [model.actuator(k).name for k in range(model.nu)] == list(JOINT_NAMES)
    assert [model.actuator_trnid[k, 0] for k in range(model.nu)] == list(range(1, 9))
    sensors = [model.sensor(k).name for k in range(model.nsensor)]
    assert sensors[:3] == ["gyro", "accelerometer", "upvector"]
    assert sensors[3:] == [f"pos.{joint}" for joint in JOINT_NAMES] + [f"vel.{joint}" for joint in JOINT_NAMES]
    assert model.body(1).name == "torso"
    assert model.site("imu_location").bodyid == 1
    assert model.camera("track").id >= 0
    assert model.opt.timestep == 0.001
    assert (model.nq, model.nv, model.nu, model.na) == (15, 14, 8, 0)


@every_kit
def test_the_mass_is_what_the_paper_weighed(kit: str) -> None:
    model = load(kit)
    assert model.body_subtreemass[0] == pytest.approx(KITS[kit].total_mass_kg)
    assert (model.body_mass[1:] > 0).all()


@every_kit
def test_friction_and_damping_stand_on_the_joints_alone_and_once(kit: str) -> None:
    model = load(kit)
    assert not model.dof_frictionloss[:6].any()
    assert not model.dof_damping[:6].any()
    for joint in JOINTS.values():
        servo = KITS[kit].servo(joint.kind)
        dof = model.joint(joint.name).dofadr[0]
        actuator = model.actuator(joint.name).id
        assert model.dof_frictionloss[dof] == pytest.approx(0.05)
        assert model.dof_damping[dof] == pytest.approx(servo.electrical_damping_nm_s_rad, rel=1e-5)
        # kv would count the same damping twice; the XL430's factory D gain is another thing.
        derivative = servo.derivative_damping_nm_s_rad()
        assert (derivative > 0) == (servo.name == "XL430-W250-T")
        assert -model.actuator_biasprm[actuator, 2] == pytest.approx(derivative, rel=1e-5)
        assert model.actuator_gainprm[actuator, 0] == pytest.approx(servo.stiffness_nm_rad(), rel=1e-5)
        assert model.actuator_forcerange[actuator, 1] == pytest.approx(servo.stall_torque_nm / 2)


@every_kit
def test_a_saturated_servo_reaches_the_speed_that_its_duty_allows(kit: str) -> None:
    """Half duty, half the free speed, less what the gear's friction takes."""
    model = on_the_stand(kit)
    model.opt.gravity[:] = 0
    model.jnt_limited[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    servo = KITS[kit].servo("hip")
    data.ctrl[0] = 50
    for _ in range(1000):
        mujoco.mj_step(model, data)
    torque = servo.stall_torque_nm / 2
    expected = servo.no_load_rad_s / 2 * (torque - 0.05) / torque
    assert data.qvel[0] == pytest.approx(expected, rel=0.02)


@every_kit
def test_it_stands_still_at_home(kit: str) -> None:
    model = load(kit)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    np.testing.assert_allclose(data.ctrl, home_angles(), atol=1e-6)
    for _ in range(5000):
        mujoco.mj_step(model, data)
    assert data.qpos[2] == pytest.approx(0.148, abs=0.005)
    assert np.hypot(*data.qpos[:2]) < 1e-3
    assert data.sensor("upvector").data[2] > 0.9999
    assert data.ncon == 4
    sag = np.degrees(data.qpos[7:] - data.ctrl)
    assert np.abs(sag).max() < 3
    assert np.abs(data.qvel).max() < 0.01
    assert data.sensor("accelerometer").data[2] == pytest.approx(9.81, abs=0.02)
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(data.sensordata[-16:-8], data.qpos[7:])


@every_kit
def test_the_floors_friction_decides(kit: str) -> None:
    """On ice the robot slides although its feet are as rough as ever: on a slope it starts at the floor's friction."""
    model = load(kit)
    floor = model.geom("floor").id
    for friction, slides in ((0.1, True), (0.6, False)):
        model.geom_friction[floor, 0] = friction
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        slope = math.atan(0.3)
        model.opt.gravity[:] = (9.81 * math.sin(slope), 0, -9.81 * math.cos(slope))
        for _ in range(1500):
            mujoco.mj_step(model, data)
        assert (data.qpos[0] > 0.2) == slides, f"friction {friction}: moved {data.qpos[0]:.3f} m"


@every_kit
def test_nothing_touches_on_the_stand_within_the_joints_range(kit: str) -> None:
    model = on_the_stand(kit)
    data = mujoco.MjData(model)
    assert model.nv == 8
    low, high = model.jnt_range.T
    for corner in itertools.product((0, 1), repeat=4):
        # All legs alike, and neighbours against each other.
        data.qpos[0::2] = np.where(np.array(corner), low[0::2], high[0::2])
        for knee in (low[1], 0, high[1]):
            data.qpos[1::2] = knee
            mujoco.mj_forward(model, data)
            assert data.ncon == 0, [(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact]


@every_kit
def test_a_positive_knee_lifts_the_foot_and_a_positive_hip_turns_left(kit: str) -> None:
    model = on_the_stand(kit)
    data = mujoco.MjData(model)
    for joint in JOINTS.values():
        mujoco.mj_resetData(model, data)
        mujoco.mj_kinematics(model, data)
        before = data.geom_xpos[model.geom(f"lower_{joint.leg.name}").id].copy()
        data.joint(joint.name).qpos[0] = 0.1
        mujoco.mj_kinematics(model, data)
        after = data.geom_xpos[model.geom(f"lower_{joint.leg.name}").id]
        if joint.kind == "knee":
            assert after[2] > before[2] + 0.005
        else:
            assert np.cross(before, after)[2] > 0
