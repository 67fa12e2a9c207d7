"""A log and a model that do not belong together are told apart before anything is fitted, by one table for all commands."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plants
import pytest

from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.model.stability import growth
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid import rules
from openant_tools.sysid.rules import check_runs, without_turns

QUANTUM = 2 * np.pi / 4096
T = np.arange(0.0, 4.0, 0.01)

#: two links in a chain
CHAIN = """\
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="{integrator}"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="hip" axis="0 1 0" damping="0.3" armature="0.01" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.2">
        <joint name="knee" axis="0 1 0" damping="0.3" armature="0.01" {joint}/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.2" contype="0" conaffinity="0"/>
        <site name="foot" pos="0 0 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" {servo}/>
    <position name="knee" joint="knee" kp="5" forcerange="-4 4"/>
  </actuator>
  {more}
</mujoco>
"""
PLAIN = {"step": "0.002", "integrator": "implicitfast", "joint": "", "servo": 'kp="5" forcerange="-4 4"', "more": ""}


def chain(folder: Path, **said: str) -> Path:
    return plants.write(folder / "chain.xml", CHAIN.format(**{**PLAIN, **said}))


def played(folder: Path, t: np.ndarray = T, scale: float = 1.0, **more: np.ndarray) -> Run:
    """What the plain chain does on sines of its own for each joint."""
    cmd = {joint: scale * np.sin(2 * np.pi * rate * (t - t[0])) for joint, rate in (("hip", 0.6), ("knee", 0.9))}
    columns = {f"cmd.{joint}": values for joint, values in cmd.items()}
    columns |= {f"pos.{joint}": np.zeros(len(t)) for joint in cmd}
    run = Run("log", Facts(("hip", "knee"), setup="stand", resolution={"pos": QUANTUM}), t, columns)
    pos = Rollouts(load_plant(chain(folder)), [run])().pos[0]
    columns |= {f"pos.{joint}": np.round(pos[:, j] / QUANTUM) * QUANTUM for j, joint in enumerate(cmd)}
    return replace(run, columns={**columns, **more})


def command(*words: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return int(left.value.code or 0)  # type: ignore[arg-type]


def said_of(run: Run, model: Path) -> tuple[str, ...]:
    return check_runs([run], [load_plant(model, run.joints)])


def refused(run: Run, model: Path) -> str:
    with pytest.raises(BadInput) as caught:
        check_runs([run], [load_plant(model, run.joints)], fitting=False)
    return str(caught.value)


# --- refused ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hz", "factor", "unit"), [(1000, 1e3, "ms"), (200, 1e3, "ms"), (20, 1e6, "µs"), (100, 1e9, "ns")]
)
def test_time_that_is_not_in_seconds_is_refused(hz: float, factor: float, unit: str, tmp_path: Path) -> None:
    run = played(tmp_path, np.arange(0.0, 4.0, 1 / hz))
    assert f"t looks like {unit}" in refused(replace(run, t=run.t * factor), chain(tmp_path))


def test_a_log_with_few_rows_and_quick_servos_is_in_seconds(tmp_path: Path) -> None:
    """A row every other second, a step every minute; and a joint that is held and sags."""
    t = np.arange(0.0, 600.0, 2.0)
    cmd = 0.4 * (np.floor(t / 60) % 2)
    pos = 0.4 * (np.floor((t - 0.1) / 60) % 2)
    columns = {"cmd.hip": cmd, "pos.hip": pos, "cmd.knee": 0 * t, "pos.knee": 0.2 * t / t[-1]}
    run = Run("slow", Facts(("hip", "knee"), resolution={"pos": QUANTUM}), t, columns)
    assert not [line for line in said_of(run, chain(tmp_path)) if "looks like" in line]


@pytest.mark.parametrize("hz", [100, 1000])
def test_time_that_was_divided_once_too_often_is_refused(hz: float, tmp_path: Path) -> None:
    run = played(tmp_path, np.arange(0.0, 4.0, 1 / hz))
    assert "t is too small to be in s" in refused(replace(run, t=run.t * 1e-3), chain(tmp_path))


@pytest.mark.parametrize("joints", [("knee",), ("hip", "knee")])
def test_commands_and_positions_in_each_others_place_are_refused(joints: tuple[str, ...], tmp_path: Path) -> None:
    run = played(tmp_path)
    other = {"cmd": "pos", "pos": "cmd"}
    columns = {f"{name}.{joint}": run.columns[f"{other[name]}.{joint}"] for name in other for joint in joints}
    assert f"cmd.{joints[0]} follows pos.{joints[0]}" in refused(
        replace(run, columns={**run.columns, **columns}), chain(tmp_path)
    )


def test_a_joint_that_is_led_by_hand_is_no_exchange(tmp_path: Path) -> None:
    """Its goal follows it, torque off."""
    run = played(tmp_path)
    led = {"cmd.knee": run.columns["pos.knee"], "pos.knee": run.columns["cmd.knee"], "torque.knee": 0 * T}
    said_of(replace(run, columns={**run.columns, **led}), chain(tmp_path))


def test_a_ramp_that_gravity_bends_is_no_exchange(tmp_path: Path) -> None:
    run = played(tmp_path)
    rises = np.clip(T / 2, 0, 1)
    columns = {**run.columns, "cmd.knee": rises, "pos.knee": np.round(0.8 * rises**1.5 / QUANTUM) * QUANTUM}
    said_of(replace(run, columns=columns), chain(tmp_path))


def test_a_joint_of_two_servos_is_refused_and_one_with_a_damper_is_not(tmp_path: Path) -> None:
    model = chain(tmp_path)

    def beside(actuator: str) -> Path:
        return plants.write(tmp_path / "two.xml", model.read_text().replace("</actuator>", f"{actuator}</actuator>"))

    second = beside('<position name="spare" joint="knee" kp="5"/>')
    assert "knee has two position servos in the model: beside the one that is commanded 'spare'" in refused(
        played(tmp_path), second
    )
    said_of(played(tmp_path), beside('<velocity joint="knee" kv="0.1"/>'))


def test_stamps_of_commands_in_milliseconds_are_refused(tmp_path: Path) -> None:
    run = played(tmp_path, cmd_t=1000 * T + 0.5)
    assert "cmd_t goes on to 3990 s after the first row, t to 3.99 s" in refused(run, chain(tmp_path))


def test_two_joints_of_eight_and_a_ring_of_three_are_found_exchanged() -> None:
    t = np.arange(0.0, 8.0, 0.02)
    columns = {}
    for k, joint in enumerate(JOINT_NAMES):
        middle = -0.8 if "knee" in joint else 0.0
        # A fast motion and a slow servo: the position is late by a good part of a period.
        columns[f"cmd.{joint}"] = middle + 0.2 * np.sin(2 * np.pi * (0.5 + 0.23 * k) * t)
        columns[f"pos.{joint}"] = middle + 0.2 * np.sin(2 * np.pi * (0.5 + 0.23 * k) * (t - 0.08))
    run = Run("ant", Facts(JOINT_NAMES, resolution={"pos": QUANTUM}), t, columns)
    model = nominal_model_path("standard")
    said_of(run, model)
    a, b, c = (f"pos.{joint}" for joint in ("knee_fr", "hip_fl", "knee_rl"))
    two = {**columns, a: columns[b], b: columns[a]}
    assert re.search(
        r"pos\.knee_fr follows cmd\.hip_fl, and pos\.hip_fl follows cmd\.knee_fr",
        refused(replace(run, columns=two), model),
    )
    three = {**columns, a: columns[b], b: columns[c], c: columns[a]}
    assert "pos.knee_rl follows cmd.knee_fr" in refused(replace(run, columns=three), model)


def test_a_joint_that_is_held_may_be_the_other_of_two(tmp_path: Path) -> None:
    run = played(tmp_path)
    still = {**run.columns, "cmd.knee": 0 * T, "pos.knee": run.columns["pos.hip"], "pos.hip": 0 * T}
    assert "pos.hip follows cmd.knee, and pos.knee follows cmd.hip" in refused(
        replace(run, columns=still), chain(tmp_path)
    )


@pytest.mark.parametrize("gear", [2.0, -1.0, 0.5])
def test_a_servo_with_a_gear_is_refused_and_written_out_without(gear: float, tmp_path: Path) -> None:
    words = refused(played(tmp_path), chain(tmp_path, servo=f'kp="1.25" kv="0.1" forcerange="-2 2" gear="{gear}"'))
    assert f"the actuator of hip has gear {gear:g}" in words
    if gear == 2:
        assert "kp=5 kv=0.4 forcerange=-4 4" in words


def test_the_gear_of_what_is_no_servo_is_nobodys_concern(tmp_path: Path) -> None:
    model = chain(tmp_path)
    text = model.read_text().replace("</actuator>", '<motor name="wheel" joint="hip" gear="30"/></actuator>')
    said_of(played(tmp_path), plants.write(tmp_path / "wheel.xml", text))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_an_unstable_model_is_refused_and_nothing_is_left_of_it(
    integrator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_table(played(tmp_path), tmp_path / "log.csv")
    stiff = chain(tmp_path, step="0.02", integrator=integrator, servo='kp="20000"')
    for words in (("gap", "measure"), ("sysid", "fit", "--out", "fit")):
        assert command(*words, "log", "--model", stiff) == 2
        line = capfd.readouterr().err.strip().splitlines()[-1]
        assert "the model is unstable" in line
        assert "timestep" in line.split("→")[1]
    assert not list(tmp_path.glob("MUJOCO*"))


@pytest.mark.parametrize(
    ("step", "integrator", "servo"),
    [
        ("0.02", "Euler", 'kp="20000" forcerange="-4 4"'),
        ("0.02", "implicitfast", 'kp="3000" forcerange="-1 1"'),
        ("0.005", "implicitfast", 'kp="20000" forcerange="-0.5 0.5"'),
        ("0.005", "Euler", 'kp="5" kv="20" forcerange="-4 4"'),
        ("0.005", "RK4", 'kp="20000" forcerange="-4 4"'),
    ],
)
def test_a_model_that_only_its_limit_of_force_keeps_together_is_unstable_too(
    step: str, integrator: str, servo: str, tmp_path: Path
) -> None:
    """It trembles where a command rests, and never goes far: no number in it is out of bounds."""
    line = refused(played(tmp_path), chain(tmp_path, step=step, integrator=integrator, servo=servo))
    assert "the model is unstable: its servos tremble without end in steps of" in line
    finer = re.search(r'timestep="([\d.e-]+)" keeps it together', line)
    if finer:
        calm = chain(tmp_path, step=finer[1], integrator=integrator, servo=servo)
        check_runs([played(tmp_path)], [load_plant(calm)], fitting=False)


@pytest.mark.parametrize(
    "said",
    [
        {"step": "0.01", "servo": 'kp="100" kv="3" forcerange="-4 4"'},
        {"step": "0.005", "integrator": "Euler", "servo": 'kp="5" forcerange="-4 4"', "joint": 'frictionloss="0.3"'},
        {"servo": 'kp="5" forcerange="-0.05 0.05"'},  # too weak to follow
        {
            "servo": 'kp="0.05" forcerange="-4 4"',
            "more": '<option gravity="0 0 9.81"/>',
        },  # upside down, it cannot stand
        {"servo": 'kp="60" forcerange="-4 4" delay="0.02" nsample="11"'},
        {"servo": 'kp="60" forcerange="-4 4" timeconst="0.05"'},
    ],
)
def test_a_model_that_is_soft_weak_slow_or_rubs_is_not_unstable(said: dict[str, str], tmp_path: Path) -> None:
    run = played(tmp_path)
    check_runs([run], [load_plant(chain(tmp_path, **said))], fitting=False)


def test_the_nominal_ant_holds_still() -> None:
    for kit in ("standard", "lite"):
        plant = load_plant(nominal_model_path(kit), JOINT_NAMES)
        for pose in (np.zeros(8), np.tile([0.5, -1.0], 4)):
            assert growth(plant, pose) < 0


# --- said, and gone on -----------------------------------------------------------------------------------------------------


def test_what_the_model_cuts_is_said_before_the_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_table(played(tmp_path), tmp_path / "log.csv")
    model = chain(tmp_path, joint='range="-0.5 0.5" limited="true"', servo='kp="5" forcerange="-4 4" inheritrange="1"')
    assert command("gap", "measure", tmp_path / "log", "--model", model) == 0
    heard = capsys.readouterr().err
    assert re.search(
        r"cmd\.hip goes to −?57\.\d°, the model's ctrlrange is −28\.6 to 28\.6°: \d+ % of its commands", heard
    )
    assert "cmd.knee" not in heard
    assert re.search(
        r"pos\.knee was measured at −?\d+\.\d°, beyond the model's range −28\.6 to 28\.6°, in \d+ %", heard
    )


def test_a_fit_goes_through_the_rules_once_and_says_each_note_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def counted(run: Run, *rest: Any) -> Iterator[rules.Finding]:
        asked.append(run.name)
        return findings(run, *rest)

    findings = rules.findings
    monkeypatch.setattr(rules, "findings", counted)
    run = played(tmp_path)
    columns = {**run.columns, "pos.hip": 0.9 * run.columns["pos.hip"]}
    write_table(replace(run, columns=columns), tmp_path / "log.csv")
    model = chain(tmp_path, servo='kp="5" forcerange="-4 4" ctrlrange="-0.5 0.5"')
    command("sysid", "fit", tmp_path / "log", "--model", model, "--kind", "stiffness", "--out", tmp_path / "fit")
    assert asked == ["log"]
    said, heard = capsys.readouterr()
    notes = json.loads((tmp_path / "fit" / "fit.json").read_text())["notes"]
    assert "cmd.hip goes to" in notes[0]
    assert notes[0] in heard
    for note in notes:
        assert (said + heard).count(note) == 1, note


def test_a_joint_without_a_servo_is_said_to_hang_limp(tmp_path: Path) -> None:
    model = chain(tmp_path)
    text = model.read_text().replace('<position name="hip" joint="hip" kp="5" forcerange="-4 4"/>', "")
    plant = load_plant(plants.write(tmp_path / "limp.xml", text))
    (said,) = check_runs([played(tmp_path)], [plant])
    assert "cmd.hip is logged, and no position servo of the model drives hip" in said


def test_a_servo_may_act_in_the_parents_frame(tmp_path: Path) -> None:
    """Of a hinge that is the same."""
    text = chain(tmp_path).read_text().replace('name="hip" joint="hip"', 'name="hip" jointinparent="hip"')
    assert load_plant(plants.write(tmp_path / "parent.xml", text)).joints == ("hip", "knee")


def test_what_lies_within_is_not_spoken_of(tmp_path: Path) -> None:
    model = chain(tmp_path, joint='range="-2 2" limited="true"', servo='kp="5" ctrlrange="-1.2 1.2"')
    assert said_of(played(tmp_path), model) == ()


@pytest.mark.parametrize("wrap", [lambda x: (x + np.pi) % (2 * np.pi) - np.pi, lambda x: x % (2 * np.pi)])
def test_wrapped_angles_go_on(wrap: Callable[[np.ndarray], np.ndarray], tmp_path: Path) -> None:
    """Whether to ±π or to 0 … 2π: what is used is what was measured, to a whole turn."""
    model = chain(tmp_path)
    run = played(tmp_path, scale=1.2)
    true = run.columns["pos.hip"] + 2.5
    shifted = {"cmd.hip": run.columns["cmd.hip"] + 2.5, "pos.hip": true}
    both = replace(run, columns={**run.columns, **{name: wrap(values) for name, values in shifted.items()}})
    only = replace(run, columns={**run.columns, **shifted, "pos.hip": wrap(true)})
    for one in (both, only):
        wraps = bool(np.abs(np.diff(one.columns["pos.hip"])).max() > 5)
        assert any("pos.hip jumps by a turn" in line for line in said_of(one, model)) == wraps
        went = without_turns(one, run.joints).columns
        assert np.allclose(went["pos.hip"] - went["cmd.hip"], true - shifted["cmd.hip"], atol=1e-9)


def test_a_whole_turn_between_command_and_position_is_taken_out(tmp_path: Path) -> None:
    run = played(tmp_path)
    turned = replace(run, columns={**run.columns, "pos.knee": run.columns["pos.knee"] - 2 * np.pi})
    assert any("pos.knee is a turn (−360°) from cmd.knee" in line for line in said_of(turned, chain(tmp_path)))
    assert np.allclose(without_turns(turned, run.joints).columns["pos.knee"], run.columns["pos.knee"])


def test_what_looks_like_degrees_is_said(tmp_path: Path) -> None:
    run = played(tmp_path, scale=0.3)
    degrees = {name: np.degrees(values) for name, values in run.columns.items()}
    said = said_of(replace(run, columns=degrees, facts=replace(run.facts, resolution={})), chain(tmp_path))
    assert any("pos.hip goes in steps of 0.0879" in line and "degrees" in line for line in said)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('<equality><joint joint1="knee" joint2="hip"/></equality>', "hip is coupled to knee by the equality 'joint'"),
        (
            '<equality><connect name="loop" body1="lower" body2="world" anchor="0 0 -0.2"/></equality>',
            "hip is coupled to knee by the equality 'loop'",
        ),
        (
            '<tendon><fixed name="belt" stiffness="2"><joint joint="hip" coef="1"/><joint joint="knee" coef="-1"/></fixed></tendon>',
            "knee is coupled to hip by the tendon 'belt'",
        ),
    ],
)
def test_joints_that_are_coupled_are_named(more: str, words: str, tmp_path: Path) -> None:
    run = played(tmp_path)
    assert any(words in line for line in said_of(run, chain(tmp_path, more=more)))
    off = more.replace("<joint joint1", '<joint active="false" joint1').replace("<connect", '<connect active="false"')
    assert not any(
        "is coupled" in line for line in said_of(run, chain(tmp_path, more=off.replace('stiffness="2"', "")))
    )


def test_a_run_of_one_row_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = played(tmp_path)
    write_table(run, tmp_path / "log.csv")
    write_table(run.between(0.0, 0.005), tmp_path / "row.csv")
    model = chain(tmp_path)
    assert command("gap", "measure", tmp_path / "log", tmp_path / "row", "--model", model) == 0
    assert "row.csv: it has one row and is left out" in capsys.readouterr().err
    assert command("gap", "measure", tmp_path / "row", "--model", model) == 2
    assert command("rec", "info", tmp_path / "row") == 0
    assert "one row" in capsys.readouterr().out


# --- rec info, thermal -----------------------------------------------------------------------------------------------------


def test_rec_info_shows_whatever_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Degrees a second, kelvins, milliseconds, rows out of order, columns of nobody: notes, and the figures all the same."""
    run = played(tmp_path)
    spoilt = replace(
        run,
        t=1000 * T,
        columns={**run.columns, "vel.hip": np.full(len(T), -500.0), "temp.hip": np.full(len(T), 310.0)},
    )
    write_table(spoilt, tmp_path / "log.csv")
    assert command("rec", "info", tmp_path / "log", "--model", chain(tmp_path), "--json", tmp_path / "info.json") == 0
    out = capsys.readouterr().out
    assert f"{len(T)} rows" in out
    notes = json.loads((tmp_path / "info.json").read_text())["notes"]
    assert all(f"note: {note}" in out for note in notes)
    for words in ("temperatures are in °C", "velocities are in rad/s", "t looks like ms"):
        assert any(words in note for note in notes), words

    lines = (tmp_path / "log.csv").read_text().splitlines()
    (tmp_path / "log.csv").write_text(
        "\n".join([lines[0] + ",pos.tail", *(f"{line},0" for line in (*lines[2:], lines[1]))])
    )
    assert command("rec", "info", tmp_path / "log") == 0
    out = capsys.readouterr().out
    assert "no such joint: tail" in out
    assert "time runs backwards" in out


# --- which model -----------------------------------------------------------------------------------------------------------


def test_the_model_that_is_named_is_the_one_that_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = played(tmp_path)
    model = chain(tmp_path)
    soft = plants.write(tmp_path / "soft.xml", model.read_text().replace('kp="5"', 'kp="2"'))
    write_table(run, tmp_path / "log.csv")
    named = tmp_path / "named.csv"
    write_table(replace(run, path=named, facts=replace(run.facts, model="chain.xml")), named)

    def gap(*words: object) -> float:
        assert command("gap", "measure", *words, "--json", tmp_path / "gap.json") == 0
        return float(json.loads((tmp_path / "gap.json").read_text())["signals"]["pos"]["gap"])

    far = gap(tmp_path / "log", "--model", soft)
    assert gap(tmp_path / "named", "--model", soft) == pytest.approx(far)
    assert "its own model is chain.xml, and" in capsys.readouterr().err
    assert gap(tmp_path / "named", "--model", model) < 0.05 * far
    assert gap(tmp_path / "named") < 0.05 * far  # its own, without a robot's folder
    assert "its own model" not in capsys.readouterr().err
