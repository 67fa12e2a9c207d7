"""Bad recordings are named before any number is given."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import plants
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid import rules
from openant_tools.sysid.quality import check_model, without_errors
from openant_tools.sysid.rules import check_runs

JOINTS = ("hip_rr", "knee_rr", "hip_fr", "knee_fr")
QUANTUM = 2 * np.pi / 4096


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_plant(nominal_model_path("standard"), JOINTS)


def good_run(seconds: float = 6.0) -> Run:
    """Four joints, each on a motion of its own, followed as a servo follows: late and in steps of its encoder."""
    t = np.arange(0.0, seconds, 0.02)
    columns = {}
    for k, joint in enumerate(JOINTS):

        def angle(at: np.ndarray, k: int = k) -> np.ndarray:
            return (-0.8 if k % 2 else 0.0) + 0.3 * np.sin(2 * np.pi * (0.4 + 0.27 * k) * at)

        columns[f"cmd.{joint}"] = angle(t)
        columns[f"pos.{joint}"] = np.round(angle(t - 0.05) / QUANTUM) * QUANTUM
    return Run("good", Facts(JOINTS, resolution={"pos": QUANTUM}), t, columns, Path("good.parquet"))


def with_columns(**changed: np.ndarray) -> Run:
    run = good_run()
    return replace(run, columns={**run.columns, **{name.replace("__", "."): v for name, v in changed.items()}})


def refused(run: Run, plant: Plant) -> str:
    with pytest.raises(BadInput) as caught:
        check_runs([good_run(), run], [plant, plant])
    assert "good.parquet" in str(caught.value)
    return str(caught.value)


def test_a_good_run_passes(plant: Plant) -> None:
    check_runs([good_run()], [plant])


def test_too_short(plant: Plant) -> None:
    assert "too short to fit: 0.48 s" in refused(good_run(0.5), plant)


def test_nothing_moves(plant: Plant) -> None:
    still = {f"pos__{joint}": np.full(300, -0.4) for joint in JOINTS}
    assert "nothing moves" in refused(with_columns(**still), plant)


def test_a_dead_joint_is_named(plant: Plant) -> None:
    message = refused(with_columns(pos__knee_rr=np.full(300, -0.8)), plant)
    assert "knee_rr is commanded over 34.4° and does not move" in message
    assert "--joint" in message


def test_swapped_columns_are_named(plant: Plant) -> None:
    run = good_run()
    swapped = with_columns(pos__hip_rr=run.columns["pos.hip_fr"], pos__hip_fr=run.columns["pos.hip_rr"])
    assert "pos.hip_rr follows cmd.hip_fr, and pos.hip_fr follows cmd.hip_rr" in refused(swapped, plant)


def test_a_reversed_joint_is_named(plant: Plant) -> None:
    assert "hip_fr moves against its command" in refused(
        with_columns(pos__hip_fr=-good_run().column("pos.hip_fr")), plant
    )


def test_degrees_are_named(plant: Plant) -> None:
    run = good_run()
    message = refused(with_columns(pos__knee_fr=np.degrees(run.column("pos.knee_fr"))), plant)
    assert "pos.knee_fr swings 57 times as far as cmd.knee_fr" in message
    assert "in rad" in message


def test_units_are_named_where_the_model_sets_no_range(tmp_path: Path) -> None:
    pendulum = load_plant(plants.write(tmp_path / "pendulum.xml", plants.pendulum()))
    t = np.arange(0.0, 6.0, 0.02)
    cmd, pos = 0.5 * np.sin(2 * t), np.round(0.5 * np.sin(2 * (t - 0.05)) / QUANTUM) * QUANTUM

    def run(cmd: np.ndarray, pos: np.ndarray) -> Run:
        return plants.run_of({"cmd.joint": cmd, "pos.joint": pos}, t, ["joint"])

    check_runs([run(cmd, pos)], [pendulum])
    for scale, words in ((180 / np.pi, "swings 57 times as far"), (4096 / (2 * np.pi), r"swings 65\d times as far")):
        with pytest.raises(
            BadInput, match=rf"pos\.joint {words} as cmd\.joint: they are in different units → give both"
        ):
            check_runs([run(cmd, scale * pos)], [pendulum])
        with pytest.raises(BadInput, match=rf"cmd\.joint {words} as pos\.joint"):
            check_runs([run(scale * cmd, pos)], [pendulum])
    said = check_runs([run(np.degrees(cmd), np.degrees(pos))], [pendulum])
    assert any("pos.joint goes in steps of 0.0879 to 28.7: it looks like degrees" in line for line in said)


def test_a_model_of_another_robot_is_named(tmp_path: Path) -> None:
    """Its arm is three hundred times too heavy for its servo, and hangs."""
    own = load_plant(plants.write(tmp_path / "pendulum.xml", plants.pendulum()))
    heavy = plants.pendulum().replace('mass="0.3"', 'mass="90"')
    other = load_plant(plants.write(tmp_path / "heavy.xml", heavy))
    t = np.arange(0.0, 5.0, 0.01)
    columns = plants.drive(own.model, ["joint"], t, plants.sweep(t, 1, reach=1.2))
    run = plants.run_of(columns, t, ["joint"], "swing")
    check_model(run, own, Rollouts(own, [run])().pos[0])
    with pytest.raises(
        BadInput, match=r"swing: joint moves otherwise than in the model altogether: it varies by \d+\.\d°"
    ):
        check_model(run, other, Rollouts(other, [run])().pos[0])
    with pytest.raises(
        BadInput, match="the model's simulation of joint fails with this run's commands → check the model"
    ):
        check_model(run, own, np.full((len(t), 1), np.inf))


def test_spikes_are_taken_out_and_nothing_else(plant: Plant) -> None:
    run = good_run()
    chance = np.random.default_rng(3)
    rows = 20 + 7 * chance.permutation(38)[:12]
    spoilt = run.column("pos.knee_fr").copy()
    spoilt[rows] += chance.choice([-1, 1], 12) * chance.uniform(0.05, 3.0, 12)
    cleaned, found = without_errors(with_columns(pos__knee_fr=spoilt), JOINTS)
    assert dict(found.glitches) == {"knee_fr": 12}
    assert dict(found.missing) == {}
    assert np.array_equal(np.flatnonzero(np.isnan(cleaned.column("pos.knee_fr"))), np.sort(rows))
    for joint in JOINTS[:3]:
        assert np.array_equal(cleaned.column(f"pos.{joint}"), run.column(f"pos.{joint}"))


@given(
    gain=st.floats(2.0, 60.0),
    reach=st.floats(0.05, 1.2),
    rate=st.sampled_from([50.0, 100.0, 200.0]),
    jitter=st.floats(0.0, 0.3),
    seed=st.integers(0, 1000),
)
@example(gain=29.0, reach=0.671875, rate=50.0, jitter=0.25, seed=0)  # the same, turned back by the step within a row
@example(gain=32.0, reach=0.6640625, rate=50.0, jitter=0.25, seed=0)  # a step as the ringing of the last one peaks
@settings(max_examples=40)
def test_no_true_motion_is_a_spike(gain: float, reach: float, rate: float, jitter: float, seed: int) -> None:
    """Steps of a stiff and hardly damped servo, sampled with jitter by a coarse encoder."""
    model = mujoco.MjModel.from_xml_string(
        plants.pendulum(
            f'<position {plants.SERVO} kp="{gain}" forcerange="-3 3"/>', joint='damping="0.02" armature="0.004"'
        )
    )
    t = plants.jittering(2.0, rate, jitter / rate, seed)
    command = reach * np.sign(np.sin(2 * np.pi * 1.3 * t))[:, None]
    columns = plants.drive(model, ["joint"], t, command, noise=3e-4, quantum=plants.ENCODER_RAD, seed=seed)
    _, found = without_errors(plants.run_of(columns, t, ["joint"]), ["joint"])
    assert not found.glitches


def test_what_was_not_read_is_no_position(plant: Plant) -> None:
    """A failed read keeps the column's last value: `ok` tells."""
    ok = np.ones(300)
    ok[40:60] = 0
    cleaned, found = without_errors(with_columns(ok__hip_fr=ok), JOINTS)
    assert dict(found.missing) == {"hip_fr": 20}
    assert np.isnan(cleaned.column("pos.hip_fr")[40:60]).all()


def test_a_servo_that_is_saturated_throughout_is_named(plant: Plant) -> None:
    run = good_run()
    limited = replace(run, facts=replace(run.facts, registers={"hip_rr": {"pwm_limit": 442}}))
    duty = np.full(len(run.t), 442 / 885)
    limited = replace(limited, columns={**limited.columns, "pwm.hip_rr": duty})
    assert "hip_rr works at its torque limit in 100 % of the samples" in refused(limited, plant)


def test_saturation_shows_without_duty_too(plant: Plant) -> None:
    run = good_run()
    held = np.where(np.arange(len(run.t)) % 2 == 0, 0.01, -0.01)
    message = refused(with_columns(cmd__hip_rr=run.column("cmd.hip_rr") + 2.0, pos__hip_rr=held), plant)
    assert "hip_rr works at its torque limit" in message


def test_no_rule_hangs_on_a_number_that_was_set_by_hand(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth less or a quarter more of it, and the same is said of a good log and of one of each fault."""
    run = good_run()
    logs = [
        run,
        good_run(3.0),
        with_columns(pos__knee_rr=np.full(300, -0.8)),
        with_columns(pos__hip_rr=run.column("pos.hip_fr"), pos__hip_fr=run.column("pos.hip_rr")),
        with_columns(pos__hip_fr=-run.column("pos.hip_fr")),
        with_columns(pos__knee_fr=np.degrees(run.column("pos.knee_fr"))),
        with_columns(cmd__hip_rr=run.column("pos.hip_rr"), pos__hip_rr=run.column("cmd.hip_rr")),
        replace(run, t=1e3 * run.t),
        replace(run, t=1e-3 * run.t),
    ]

    def said() -> list[str]:
        return [_without_numbers(log, plant) for log in logs]

    first = said()
    assert len(set(first)) == len(logs) - 1, "of two good ones the same is said, of each fault something else"
    for name in (
        "MOVES_QUANTA",
        "SATURATED",
        "BETTER",
        "LEADS",
        "OTHER_UNIT",
        "CREEPS_RAD_S",
        "FLIES_RAD_S",
        "SPARSE_S",
    ):
        for times in (0.8, 1.25):
            with monkeypatch.context() as patch:
                patch.setattr(rules, name, times * getattr(rules, name))
                assert said() == first, (name, times)


def _without_numbers(run: Run, plant: Plant) -> str:
    try:
        lines = check_runs([run], [plant])
    except BadInput as error:
        lines = [str(error)]
    return re.sub(r"[\d.,]+", "#", "\n".join(lines))


def test_joints_that_are_commanded_alike_are_not_called_swapped(plant: Plant) -> None:
    run = good_run()
    check_runs([with_columns(cmd__hip_fr=run.column("cmd.hip_rr"), pos__hip_fr=run.column("pos.hip_rr"))], [plant])


def spoiled() -> dict[str, tuple[Run, str]]:
    """Each way of being bad: the run, and what must be said of it."""
    good, t = good_run(), good_run().t
    duty = with_columns(pwm__hip_rr=np.full(len(t), 0.5))
    columns = good.columns
    return {
        "too short": (good_run(0.5), "too short to fit"),
        "no motion": (with_columns(**{f"pos__{joint}": np.full(len(t), -0.4) for joint in JOINTS}), "nothing moves"),
        "dead joint": (with_columns(pos__knee_rr=np.full(len(t), -0.8)), "knee_rr is commanded over"),
        "saturated": (
            replace(duty, facts=replace(duty.facts, registers={"hip_rr": {"pwm_limit": 442}})),
            "hip_rr works at its torque limit in 100 %",
        ),
        "wrong unit": (with_columns(pos__knee_fr=np.degrees(columns["pos.knee_fr"])), "angles are in rad"),
        "swapped": (
            with_columns(pos__hip_rr=columns["pos.hip_fr"], pos__hip_fr=columns["pos.hip_rr"]),
            "follows cmd.hip_fr",
        ),
    }


@pytest.mark.parametrize("how", [*spoiled(), "wrong model"])
def test_the_command_names_bad_data_and_gives_no_number(
    how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = nominal_model_path("standard")
    if how == "wrong model":
        own = load_plant(plants.write(tmp_path / "pendulum.xml", plants.pendulum()))
        model = plants.write(tmp_path / "heavy.xml", plants.pendulum().replace('mass="0.3"', 'mass="90"'))
        t = np.arange(0.0, 3.0, 0.01)
        columns = plants.drive(own.model, ["joint"], t, plants.sweep(t, 1, reach=1.2))
        run, words = plants.run_of(columns, t, ["joint"], "bad"), "moves otherwise than in the model altogether"
    else:
        run, words = spoiled()[how]
    write_table(replace(run, name="bad"), tmp_path / "bad.parquet")
    with pytest.raises(SystemExit) as left:
        main(["sysid", "fit", str(tmp_path / "bad.parquet"), "--model", str(model), "--out", str(tmp_path / "fit")])
    printed = capsys.readouterr()
    assert left.value.code == 2
    assert printed.out == ""
    assert words in printed.err.strip().splitlines()[-1]
    assert "→" in printed.err
    assert not (tmp_path / "fit").exists()


def test_servos_that_could_not_go_where_they_were_sent_are_named_by_their_registers(plant: Plant) -> None:
    def with_registers(**registers: float) -> Run:
        run = good_run()
        return replace(run, facts=replace(run.facts, registers={"knee_rr": registers}))

    words = refused(with_registers(min_position_limit=1900, max_position_limit=2200), plant)
    assert "knee_rr is commanded over 34.4°" in words
    assert "min_position_limit = 1900 and max_position_limit = 2200 leave 26.4°" in words
    assert "profile_velocity = 1 lets it turn (1.37 °/s)" in refused(with_registers(profile_velocity=1), plant)
    check_runs([with_registers(min_position_limit=1900, max_position_limit=2200, operating_mode=4)], [plant])
    check_runs([with_registers(min_position_limit=0, max_position_limit=4095, profile_velocity=0)], [plant])
