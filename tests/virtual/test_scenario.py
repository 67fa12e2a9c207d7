"""A scenario says what the virtual robot is and what is wrong with it; what cannot be is refused in one line."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from openant_tools.comms import protocol2 as p2
from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.virtual.body import Body, BodySettings
from openant_tools.virtual.imperfections import CATALOGUE
from openant_tools.virtual.scenario import load_scenario, parse_scenario
from openant_tools.virtual.start import build


def world_of(**table):
    return build(parse_scenario(table))


def effect(name, joints="all", **parameters):
    return {"effect": [{"effect": name, "joints": joints, "parameters": parameters}]}


def enable(world):
    """Torque on everywhere, as a client does it."""
    for servo in world.servos:
        servo.execute(p2.write(servo.id, 64, b"\1"), world.now)


def goal(world, joint, angle_rad):
    """A new goal for one joint, in the servo's own frame."""
    servo = world.servos[world.joints.index(joint)]
    pulses = 2048 + round(angle_rad * 4096 / (2 * math.pi))
    status = servo.execute(p2.write(servo.id, 116, pulses.to_bytes(4, "little", signed=True)), world.now)
    assert status is not None
    assert status.code == 0


def follow(world, joint, angle_rad, seconds=0.6, step=0.005):
    """Angles of a joint while it goes to a goal, sampled every `step` seconds."""
    enable(world)
    world.advance(world.now + 0.05)
    goal(world, joint, angle_rad)
    k, start = world.joints.index(joint), world.now
    out = []
    for n in range(1, round(seconds / step) + 1):
        world.advance(start + n * step)
        out.append(float(world.body.q[k]))
    return np.array(out)


def rise_time(path, target, step=0.005):
    return step * (1 + int(np.argmax(path > 0.5 * target)))


# ---- what a scenario can say ----


def test_without_anything_it_is_the_healthy_standard_ant():
    scenario = parse_scenario({})
    servos = scenario.world.servos
    assert [servo.registers["id"] for servo in servos] == [10, 11, 20, 21, 30, 31, 40, 41]
    assert {servo.registers["baud_rate"] for servo in servos} == {3}
    assert {servo.registers["return_delay_time"] for servo in servos} == {0}
    assert servos[0].model.name == "XC430-W240-T"
    assert servos[1].model.name == "XM430-W350-T"
    assert scenario.world.bus.latency_timer_s == 1e-3
    assert scenario.world.bus.write_read_gap_s == 2e-4
    assert not scenario.stepped


def test_a_file_with_every_section_reads(tmp_path):
    path = tmp_path / "bad day.toml"
    path.write_text("""
        seed = 7
        [robot]
        kit = "lite"
        setup = "floor"
        pose = "home"
        heading_rad = -1.0
        eeprom = "eeprom.json"
        [bus]
        baud = 4000000
        latency_timer_ms = 16
        return_delay_s = 0.0005
        chain = [["hip_rr", "knee_rr", "hip_fr", "knee_fr"], ["hip_fl", "knee_fl", "hip_rl", "knee_rl"]]
        [supply]
        volts = 11.1
        resistance_ohm = 0.3
        [imu]
        api_minor = 45
        gyro_bias = [0.01, 0, 0]
        [room]
        ambient_c = 35
        [clock]
        mode = "stepped"
        [motor]
        encoder_noise_rad = 0.0
        [[servo]]
        joint = "knee_fl"
        id = 77
        firmware = 44
        reversed = true
        spline_offset = -1
        position_p_gain = 400
        motor = { coulomb_nm = 0.1 }
        [[effect]]
        effect = "backlash"
        joints = ["knee_fl"]
        parameters = { gap_rad = 0.02 }
        [[fault]]
        cause = "broken_wire"
        where = ["hip_rr", "knee_rr"]
        from_s = 1
        depends_on = "hip_rr"
        above_rad = 0.3
        """)
    scenario = load_scenario(path)
    world = build(scenario)
    k = world.joints.index("knee_fl")
    assert scenario.stepped
    assert scenario.eeprom == tmp_path / "eeprom.json"
    assert world.servos[k].id == 77
    assert world.servos[k].baud == 4_000_000
    assert world.servos[k].get("position_p_gain") == 400
    assert world.servos[k].firmware == 44
    assert world.drives.sign[k] == -1
    assert world.drives.motors[k].coulomb_nm == 0.1
    assert world.drives.motors[0].encoder_noise_rad == 0.0
    assert world.drives.elastic
    assert world.settings.body.timestep_s == 5e-4
    assert world.drives.case[0] == 35
    assert world.settings.imu == {"api_minor": 45, "gyro_bias": (0.01, 0, 0)}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"robt": {}}, "did you mean 'robot'"),
        ({"robot": {"setpu": "stand"}}, "did you mean 'setup'"),
        ({"robot": {"setup": "flor"}}, "stand, floor, loose"),
        ({"robot": {"kit": "mini"}}, "standard, lite"),
        ({"robot": {"pose": {"knee_xx": 0.1}}}, "no joint 'knee_xx'"),
        ({"bus": {"latency_timer_ms": "fast"}}, "latency_timer_ms = 'fast'"),
        ({"bus": {"baud": 250000}}, "no servo speaks 250000"),
        ({"bus": {"chain": [["hip_r"]]}}, "no joint 'hip_r'"),
        ({"seed": -1}, "seed = -1"),
        ({"servo": {"joint": "hip_rr"}}, "two brackets"),
        ({"servo": [{"joint": "hip_xx"}]}, "did you mean 'hip_"),
        ({"servo": [{"joint": "hip_rr"}, {"joint": "hip_rr"}]}, "twice"),
        ({"servo": [{"joint": "hip_rr", "model": "XM430-W250"}]}, "did you mean"),
        ({"servo": [{"joint": "hip_rr", "position_p_gian": 3}]}, "position_p_gain"),
        ({"servo": [{"joint": "hip_rr", "id": 253}]}, "goes from 0 to 252"),
        ({"servo": [{"joint": "hip_rr", "motor": {"coulomb": 1.0}}]}, "coulomb_nm"),
        ({"motor": {"kt": "strong"}}, "kt = 'strong'"),
        ({"imu": {"gyro_bias": [1]}}, "a list of 3 numbers"),
        (effect("backlsh"), "did you mean 'backlash'"),
        (effect("action_delay"), "needs delay_s"),
        (effect("action_delay", delay=0.01), "did you mean 'delay_s'"),
        (effect("action_delay", delay_s=-0.01), "below zero"),
        (effect("action_delay", delay_s="long"), "not a number"),
        (effect("action_delay", ["knee_zz"], delay_s=0.1), "no joint 'knee_zz'"),
        (effect("action_delay", "knees", delay_s=0.1), 'joints = \'knees\''),
        ({"camera": {"fsp": 30}}, "did you mean 'fps'"),
        ({"camera": {"body": {"sise": 0.03}}}, "did you mean 'size'"),
        ({"robot": {"setup": "loose"}, **effect("payload", "body", mass_kg=0.1)}, "assembled robot"),
        ({"fault": [{"cause": "gremlins"}]}, "no fault has the cause"),
        ({"fault": [{"cause": ["bad_servo"]}]}, "no fault has the cause"),
        ({"fault": [{"cause": "bad_servo", "where": 1.5}]}, "where = 1.5"),
        (effect("action_delay", 3, delay_s=0.1), "a list of joints"),
        (effect("action_delay", [3], delay_s=0.1), "no joint 3"),
        ({"fault": [{"cause": "bad_servo"}]}, "needs a joint"),
        ({"fault": [{"cause": "bad_servo", "where": "knee_fl", "fractoin": 1}]}, "did you mean 'fraction'"),
        ({"fault": [{"cause": "duplicate_id", "where": "knee_fl"}]}, "needs of"),
        ({"fault": [{"cause": "line_noise", "byte_error": -1}]}, "not below zero"),
        ({"clock": {"mode": "fast"}}, "real, stepped"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_place_and_remedy(table, words):
    with pytest.raises(BadInput) as caught:
        parse_scenario(table, "bad.toml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("bad.toml")


def test_a_file_that_is_not_toml_or_not_there_is_named(tmp_path):
    path = tmp_path / "s.toml"
    with pytest.raises(BadInput, match=r"s\.toml: No such file"):
        load_scenario(path)
    path.write_text("seed = = 1")
    with pytest.raises(BadInput, match=r"s\.toml, line 1, column \d+: is not TOML"):
        load_scenario(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(BadInput, match="is text in UTF-16"):
        load_scenario(path)


def test_effects_of_a_fit_are_those_of_a_robot_too():
    table = effect("load_friction", ["knee_fl"], coefficient=0.1)
    table["effect"][0]["pair"] = "0123456789ab"
    assert sorted(motor.load_friction for motor in world_of(**table).drives.motors) == [0.0] * 7 + [0.1]


def test_a_disabled_effect_is_left_out():
    table = effect("action_delay", delay_s=0.05)
    table["effect"][0]["enabled"] = False
    assert world_of(**table).drives.motors[0].action_delay_s == 0


# ---- the healthy robot ----


def test_the_healthy_robot_moves_as_the_nominal_model_in_plain_mujoco():
    """Two ways to the same robot: firmware, winding and friction here, position actuators and joint damping there."""
    world = world_of()
    for servo in world.servos:
        servo.execute(p2.write(servo.id, 36, (442).to_bytes(2, "little")), 0.0)
    enable(world)
    spec = mujoco.MjSpec.from_string(nominal_mjcf("standard"))
    spec.delete(spec.joint("root"))
    spec.delete(spec.key("home"))
    spec.geom("floor").contype = spec.geom("floor").conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    real, simulated = [], []
    for n in range(200):
        t = 0.02 * n
        for k, joint in enumerate(world.joints):
            angle = 0.4 * math.sin(2 * math.pi * (0.3 + 0.3 * t) * t + k)
            goal(world, joint, angle)
            data.ctrl[k] = angle
        world.advance(t + 0.02)
        mujoco.mj_step(model, data, 20)
        real.append(world.body.q.copy())
        simulated.append(data.qpos.copy())
    error = np.array(real) - np.array(simulated)
    assert np.array(real).std(axis=0).min() > 0.2
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.004


# ---- what effects do ----


QUIET = {"motor": {"encoder_noise_rad": 0.0}}


def test_action_delay_shifts_the_response_by_its_time():
    plain = follow(world_of(**QUIET), "knee_fl", 0.3)
    late = follow(world_of(**QUIET, **effect("action_delay", delay_s=0.05)), "knee_fl", 0.3)
    assert np.allclose(late[10:], plain[:-10], atol=2e-3)


def test_lag_and_slew_slow_the_response():
    plain = rise_time(follow(world_of(**QUIET), "knee_fl", 0.3), 0.3)
    lag = rise_time(follow(world_of(**QUIET, **effect("actuator_lag", time_constant_s=0.1)), "knee_fl", 0.3), 0.3)
    slew = rise_time(follow(world_of(**QUIET, **effect("slew_limit", rate_rad_s=1.0)), "knee_fl", 0.3), 0.3)
    assert lag > plain + 0.04
    assert slew > plain + 0.05


def test_sensor_delay_makes_answers_old():
    world = world_of(**QUIET, **effect("sensor_delay", delay_s=0.03))
    follow(world, "knee_fl", 0.5, seconds=0.1)
    k = world.joints.index("knee_fl")
    angle_then = float(world.body.q[k])
    world.advance(world.now + 0.03)
    assert world.drives.sense(k, world.now).pulses == pytest.approx(2048 + angle_then * 4096 / (2 * math.pi), abs=3)


def test_friction_and_dead_zone_leave_an_error_at_rest():
    def error(**table):
        return 0.2 - follow(world_of(**QUIET, **table), "knee_fl", 0.2)[-1]

    assert abs(error()) < 0.006
    assert error(**effect("coulomb_friction", ["knee_fl"], torque_nm=0.4)) > 0.01
    assert 0.02 < error(**effect("dead_zone", ["knee_fl"], width_rad=0.06)) < 0.04


def test_a_weak_joint_and_a_torque_limit_are_slow():
    plain = rise_time(follow(world_of(**QUIET), "knee_fl", 0.5), 0.5)
    weak = rise_time(follow(world_of(**QUIET, **effect("weak_joint", ["knee_fl"], scale=0.3)), "knee_fl", 0.5), 0.5)
    limited = rise_time(follow(world_of(**QUIET, **effect("torque_limit", torque_nm=0.3)), "knee_fl", 0.5), 0.5)
    assert weak > 1.3 * plain
    assert limited > 1.3 * plain


def test_backlash_lets_the_shaft_play_by_its_gap():
    world = world_of(**QUIET, **effect("backlash", ["knee_fl"], gap_rad=0.05))
    enable(world)
    world.advance(0.3)
    k = world.joints.index("knee_fl")
    touched = []
    for torque in (0.15, -0.15):
        world.body.data.qfrc_applied[:] = 0
        rotor = world.drives.rotor[k]
        twists = []
        for _ in range(200):
            world.body.data.xfrc_applied[:] = 0
            # A hand on the leg.
            leg = world.body.model.body("lower_leg_fl").id
            world.body.data.xfrc_applied[leg, 3:] = torque * np.array([1, -1, 0]) / math.sqrt(2)
            world.advance(world.now + 0.001)
            twists.append(world.body.q[k] - world.drives.rotor[k])
        touched.append(twists[-1])
        assert abs(world.drives.rotor[k] - rotor) < 0.05
    assert abs(touched[0] - touched[1]) == pytest.approx(0.05, abs=0.01)


def test_voltage_sags_for_all_when_one_pulls():
    world = world_of(**effect("voltage_sag", resistance_ohm=2.0))
    follow(world, "knee_fl", 0.8, seconds=0.03)
    assert world.drives.voltage < 11.5
    healthy = world_of()
    follow(healthy, "knee_fl", 0.8, seconds=0.03)
    assert healthy.drives.voltage == 12.0


def test_zero_offset_shifts_what_the_encoder_says():
    world = world_of(**QUIET, **effect("zero_offset", ["hip_rr"], angle_rad=0.1))
    assert world.drives.sense(0, 0.0).pulses == pytest.approx(2048 + 0.1 * 4096 / (2 * math.pi), abs=1)


def test_a_blocked_joint_stops_early():
    path = follow(world_of(**QUIET, **effect("blocked_joint", ["knee_fl"], angle_rad=0.2)), "knee_fl", 0.6)
    assert path.max() < 0.25


def test_masses_change_and_payload_adds():
    plain, heavy = world_of(), world_of(**effect("link_mass", ["knee_fl"], scale=2.0))
    loaded = world_of(**effect("payload", "body", mass_kg=0.3, position_m=[0, 0, 0.05]))
    mass = plain.body.model.body_mass.sum()
    assert heavy.body.model.body_mass.sum() == pytest.approx(mass + 0.03)
    assert loaded.body.model.body_mass.sum() == pytest.approx(mass + 0.3)


def test_a_tilted_floor_tilts_gravity():
    world = world_of(**effect("floor_tilt", "body", angle_rad=0.1, direction=0.0))
    world.advance(0.01)
    x, _, z = world.body.accelerometer
    assert x == pytest.approx(-9.81 * math.sin(0.1), abs=1e-3)
    assert z == pytest.approx(9.81 * math.cos(0.1), abs=1e-3)


def test_feet_that_stick_press_the_floor_and_not_the_knees():
    def standing(adhesion_n):
        pose = {joint: -0.9 if "knee" in joint else 0.0 for joint in JOINTS}
        body = Body(BodySettings(setup="floor", adhesion_n=adhesion_n, pose_rad=pose), tuple(JOINTS))
        body.damping[:] = 0.05
        start = body.q.copy()
        for _ in range(1500):
            body.torque[:] = 10.0 * (start - body.q)
            body.step()
        contacts = body.data.contact[: body.data.ncon]
        return sum(float(body.data.efc_force[one.efc_address]) for one in contacts), np.abs(body.torque).max()

    (free_n, torque_nm), (stuck_n, stuck_nm) = standing(0.0), standing(1.5)
    assert stuck_n - free_n == pytest.approx(4 * 1.5, abs=0.1)
    assert stuck_nm < 1.05 * torque_nm  # as a payload of 6 N it would be half as much again


def test_dropped_commands_do_not_arrive():
    world = world_of(seed=3, **effect("command_dropout", fraction=0.5, longest_s=0.2))
    enable(world)
    heard = 0
    for n in range(400):
        world.advance(0.1 + n * 0.02)
        goal(world, "knee_fl", 0.1 * math.sin(n))
        world.advance(0.1 + n * 0.02 + 0.01)
        heard += world.drives.goal[5] == world.servos[5].get("goal_position")
    assert 120 < heard < 280


def test_a_hot_motor_derates():
    cool = world_of(**effect("thermal_derating", loss_per_c=0.01, time_constant_s=0.0))
    hot = world_of(room={"ambient_c": 65.0}, **effect("thermal_derating", loss_per_c=0.01, time_constant_s=0.0))
    assert rise_time(follow(hot, "knee_fl", 0.5), 0.5) > rise_time(follow(cool, "knee_fl", 0.5), 0.5)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_of_the_catalogue_runs(name):
    examples = {
        "longest_s": 0.1, "fraction": 0.1, "coefficients": [0.1, 0.05], "position_m": [0, 0, 0], "scale": 1.2,
        "share": 0.5, "no_load_rad_s": 4.0, "kg_m2": 0.02, "gap_rad": 0.01, "stiffness_nm_rad": 40.0, "periods": 8,
        "rotation_rad": [0.1, 0, 0], "angle_rad": 0.1, "rate_rad_s": 3.0,
    }  # fmt: skip
    parameters = {
        key: examples.get(key, 0.05) for key, default in CATALOGUE[name].parameters.items() if default is None
    }
    world = world_of(robot={"setup": "floor"}, **effect(name, "all", **parameters))
    path = follow(world, "knee_fl", -0.4, seconds=0.5)
    assert np.isfinite(path).all()
    assert np.abs(path).max() < 1.5


# ---- built in wrong ----


def test_a_reversed_joint_goes_the_other_way():
    table = {"servo": [{"joint": "hip_fl", "reversed": True}]}
    assert follow(world_of(**QUIET, **table), "hip_fl", 0.3)[-1] == pytest.approx(-0.3, abs=0.02)


def test_a_horn_one_spline_off_reads_an_eighth_of_a_turn_more():
    world = world_of(**QUIET, servo=[{"joint": "hip_fl", "spline_offset": 1}])
    assert world.drives.sense(4, 0.0).pulses == pytest.approx(2048 + 512, abs=1)


def test_motors_in_a_box_are_factory_fresh_and_none_is_plugged():
    world = world_of(robot={"setup": "loose"})
    assert {servo.id for servo in world.servos} == {1}
    assert {servo.baud for servo in world.servos} == {57_600}
    assert world.line.plugged == set()
    assert world.line.receive(p2.ping(1).encode(), 0.0, 57_600) == []
    world.plug(3, True)
    world.advance(1.0)
    assert world.line.receive(p2.ping(1).encode(), 1.0, 57_600)


def test_the_same_seed_gives_the_same_run():
    def run(seed):
        return follow(world_of(seed=seed), "knee_fl", 0.3)

    assert np.array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))
