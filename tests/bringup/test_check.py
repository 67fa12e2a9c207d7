"""The daily check: green on a robot that has not changed; names joint and part where something has."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from builder import Robot, finished, robot
from scipy.stats import binom

from openant_tools.bringup import check as check_step
from openant_tools.bringup.check import changed, check, unjudged
from openant_tools.calib import lost_answers
from openant_tools.calib.lost_answers import LostAlone, loose, lost_alone, most_lost
from openant_tools.calib.sweep import JointSweep, analyse, joint_sweep_of, sweep
from openant_tools.calib.wires import engine_config
from openant_tools.errors import BadInput
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.step import Bench, Event, Progress
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES

pytestmark = pytest.mark.usefixtures("half_rate")

HEALTHY = {
    joint: JointSweep(
        joint, 0.04, 0.002, 0.025 if joint.startswith("knee") else 0.0, 0.004, -0.787 if "hip" in joint else -1.223,
        0.787 if "hip" in joint else 1.223, 27.0, 11.9,
    )
    for joint in JOINT_NAMES
}  # fmt: skip


def now(joint: str, **different: object) -> list[str]:
    return changed(HEALTHY, {**HEALTHY, joint: replace(HEALTHY[joint], **different)})


def lost(**shares: float) -> LostAlone:
    """Shares of the answers in the reads of a slow sweep."""
    shares = dict.fromkeys(JOINT_NAMES, 0.0) | shares
    return LostAlone({joint: round(2500 * share) for joint, share in shares.items()}, 2500)


def test_nothing_changed_is_nothing_said():
    assert changed(HEALTHY, HEALTHY) == [] == loose(lost(), ())


def test_doubled_friction_names_the_joint_and_its_gear():
    (words,) = now("hip_fl", friction_nm=0.08)
    assert words.startswith("hip_fl: friction 0.080 N·m, it was 0.040 → gear")


def test_friction_within_what_a_sweep_repeats_to_is_no_finding():
    assert now("hip_fl", friction_nm=0.050) == []


def test_a_lost_foot_is_a_lighter_leg():
    (words,) = now("knee_rr", weight_nm=0.019)
    assert "knee_rr: its leg weighs 24 % less" in words
    assert "a foot was lost" in words


def test_both_stops_moved_is_a_changed_zero():
    (words,) = now("hip_rl", low_stop_rad=-0.737, high_stop_rad=0.837)
    assert words.startswith("hip_rl: its zero has changed by +2.9° (both stops moved) → horn screw or spline")


def test_one_stop_moved_is_something_in_the_way():
    (words,) = now("knee_fl", high_stop_rad=1.0)
    assert "one of its stops has moved by −12.8°" in words


def test_a_horn_on_another_spline_moves_both_stops_out_of_reach():
    (words,) = now("knee_fl", low_stop_rad=None, high_stop_rad=None)
    assert "neither of its stops is where it was" in words


@pytest.mark.parametrize(
    ("shares", "chain", "where"),
    [
        ({"knee_fl": 0.02}, (), "knee_fl: 2.0 % of its answers were lost while it moved → a loose connector between hip_fl and knee_fl"),
        ({"hip_fl": 0.02, "knee_fl": 0.02}, (), "a loose connector from the board to hip_fl"),
        ({"hip_fl": 0.02}, (("knee_fl", "hip_fl"),), "a loose connector between knee_fl and hip_fl"),
        (dict.fromkeys(JOINT_NAMES, 0.02), (), "8 of 8 servos lose answers while they move → the power plug"),
    ],
)  # fmt: skip
def test_a_loose_connector_is_named_by_how_the_cables_run(shares, chain, where):
    (words,) = loose(lost(**shares), chain)
    assert where in words


def test_what_all_lose_alike_blames_no_joint_and_names_who_loses_far_more():
    alike = {joint: 0.02 + 0.001 * k for k, joint in enumerate(JOINT_NAMES)}
    (words,) = loose(lost(**alike), ())
    assert not words.startswith("hip")
    for shared in ("power plug", "supply", "adapter", "busy computer"):
        assert shared in words
    both = loose(lost(**alike | {"knee_fl": 0.2}), ())
    assert both[0] == words
    assert [line.partition(":")[0] for line in both[1:]] == ["knee_fl"]
    assert loose(lost(**alike), (), both) == []


def named(rows: np.ndarray) -> list[str]:
    """What begins each line on these lost answers, (reads, joints)."""
    return [line.partition(":")[0] for line in loose(lost_alone(JOINT_NAMES, rows), ())]


def drawn(seed: int, reads: int = 2500, **shares: float) -> np.ndarray:
    """Answers lost by chance, each servo's apart; those of `all` together."""
    chance = np.random.default_rng(seed)
    rates = [shares.get(joint, shares.get("each", 0.0)) for joint in JOINT_NAMES]
    return (chance.random((reads, len(JOINT_NAMES))) < rates) | (chance.random((reads, 1)) < shares.get("all", 0.0))


def test_of_sound_robots_one_in_a_thousand_is_blamed_at_most():
    for reads in (100, 500, 2500, 10_000):
        kept = binom.cdf(most_lost(reads, 8), reads, lost_answers.SOUND_SHARE)
        assert 1 - kept**8 <= lost_answers.SIGNIFICANCE
        assert binom.cdf(most_lost(reads, 8) - 1, reads, lost_answers.SOUND_SHARE) ** 8 < 1 - lost_answers.SIGNIFICANCE
    for alike in (0.01, 0.05, 0.2):  # and where all lose alike, a connector beside that
        assert sum(len(named(drawn(seed, all=alike, each=alike))) > 1 for seed in range(500)) <= 1


@pytest.mark.parametrize("sound_share", [0.0002, 0.0005, 0.001, 0.002, 0.003])
@pytest.mark.parametrize("significance", [1e-4, 1e-3, 1e-2])
def test_a_verdict_does_not_hang_on_the_figures_that_are_chosen(monkeypatch, sound_share, significance):
    monkeypatch.setattr(lost_answers, "SOUND_SHARE", sound_share)
    monkeypatch.setattr(lost_answers, "SIGNIFICANCE", significance)
    for seed in range(20):
        assert named(drawn(seed, each=1e-5)) == []
        assert named(drawn(seed, each=1e-5, knee_fl=0.02)) == ["knee_fl"]
        assert len(named(drawn(seed, all=0.02))) == 1
        (words, *joints) = named(drawn(seed, all=0.02, hip_rl=0.1))
        assert (words.startswith("8 of 8 servos"), joints) == (True, ["hip_rl"])


def test_without_a_baseline_it_says_how_to_get_one(tmp_path):
    with robot(tmp_path / "ant") as ant, pytest.raises(BadInput, match="there is nothing to compare with yet"):
        ant.do(check(ant.bench))


def test_a_real_robot_is_compared_with_nothing_that_a_virtual_one_had(tmp_path):
    folder = create_robot(tmp_path / "ant")
    swept = {joint: one.as_dict() for joint, one in HEALTHY.items()}
    keep(Finding("bounds", True, "", (), "", "", data={"sweep": swept}), folder, virtual=True)
    registers = {"hip_rr": {"position_p_gain": 400}}
    keep(Finding("inventory", True, "", (), "", "", data={"registers": registers}), folder, virtual=True)
    with pytest.raises(BadInput, match="there is nothing to compare with yet"):
        finished(check(Bench(folder)))
    real, virtual = (engine_config(Bench(folder, "/dev/null", control=control)) for control in (None, "a socket"))
    assert (real.passport, virtual.passport) == ({}, registers)


def keep_baseline(ant: Robot) -> None:
    """What the step Observation bounds keeps of a healthy robot, by its sweep alone."""
    path = ant.folder.recordings / "sweep.mcap"

    def sweeping():
        run = yield from sweep(engine_config(ant.bench, imu=None), path, "slow sweep")
        limits = {motor.joint: (motor.min_rad, motor.max_rad) for motor in ant.folder.config().motors.values()}
        swept = {joint: one.as_dict() for joint, one in analyse(run, limits).items()}
        return Finding("bounds", True, "", (), "", "", data={"sweep": swept})

    finding, _ = ant.do(sweeping())
    keep(finding, ant.folder)


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """The folder of a robot whose healthy sweep is known."""
    folder = tmp_path_factory.mktemp("known") / "ant"
    with robot(folder) as ant:
        keep_baseline(ant)
    return folder


@pytest.fixture(autouse=True)
def brief_twitch(monkeypatch):
    monkeypatch.setattr(check_step, "TWITCH_S", 8.0)


@pytest.mark.slow
def test_an_unchanged_robot_is_green(known):
    with robot(known) as ant:
        finding, _ = ant.do(check(ant.bench))
        assert (finding.ok, finding.problems) == (True, ())
        assert joint_sweep_of(finding.data["sweep"]["hip_rr"]).friction_nm == pytest.approx(0.04, abs=0.01)
        assert not any(ant.torque())
        kept = ant.recorded()
        assert {f"recordings/{name}" for name in kept} >= set(finding.data["recordings"].split(", "))

        def leave(event: Event) -> None:
            if isinstance(event, Progress) and event.words == "slow sweep":
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            ant.do(check(ant.bench), ant.builder(before=leave))
        assert ant.recorded().items() > kept.items(), "a repeat that was cut short takes the place of nothing"


@pytest.mark.slow
def test_four_things_that_went_wrong_are_named_each_at_its_joint(known):
    effects = [
        {"effect": "coulomb_friction", "joints": ["hip_rr"], "parameters": {"torque_nm": 0.1}},
        {"effect": "link_mass", "joints": ["knee_fr"], "parameters": {"scale": 0.75}},
        {"effect": "zero_offset", "joints": ["hip_rl"], "parameters": {"angle_rad": 0.05}},
    ]
    fault = [{"cause": "broken_wire", "where": "knee_fl", "depends_on": "knee_fl", "above_rad": 0.9, "flicker": 0.8}]
    with robot(known, effect=effects, fault=fault) as ant:
        finding, _ = ant.do(check(ant.bench))
        words = "\n".join(finding.problems)
        assert "hip_rr: friction" in words
        (share,) = re.findall(r"knee_fr: its leg weighs (\d+) % less", words)
        assert 20 <= int(share) <= 36
        assert "hip_rl: its zero has changed by" in words
        assert "a loose connector between hip_fl and knee_fl" in words
        assert "from the board" not in words  # to hip_rl, whose answers come after knee_fl's
        assert not finding.ok


@pytest.mark.slow
def test_a_servo_that_falls_silent_during_the_check_is_named(known):
    with robot(known) as ant:

        def pull(event: Event) -> None:
            if isinstance(event, Progress) and event.words == "slow sweep":
                ant.builder().hands._remote.ask("unplug", joint="hip_fl")

        finding, _ = ant.do(check(ant.bench), ant.builder(before=pull))
        assert not finding.ok
        assert "hip_fl (id 30) has not answered" in "\n".join(finding.problems)


def test_a_servo_that_does_not_answer_is_named_before_anything_moves(known_folder):
    with robot(known_folder) as ant:
        ant.server.world.plug(1, False)
        finding, _ = ant.do(check(ant.bench))
        assert not finding.ok
        assert "look at the cable between hip_rr and knee_rr" in finding.problems[0]
        assert not any(ant.torque())


@pytest.fixture
def known_folder(tmp_path):
    folder = create_robot(tmp_path / "ant")
    swept = {joint: one.as_dict() | {"lost": 0.0} for joint, one in HEALTHY.items()}  # as it was once written
    keep(Finding("bounds", True, "", (), "", "", data={"sweep": swept}), folder)
    return folder.path


@pytest.mark.parametrize("friction", [-0.239, 0.0, float("nan"), None])
def test_a_friction_that_cannot_be_is_no_measurement(friction):
    odd = {**HEALTHY, "knee_fl": replace(HEALTHY["knee_fl"], friction_nm=friction, weight_nm=-0.028)}
    assert changed(HEALTHY, odd) == []
    words = unjudged(HEALTHY, odd)
    assert len(words) == 2
    assert all(line.startswith("knee_fl: cannot judge its ") and "because" in line for line in words)
    assert unjudged(HEALTHY, HEALTHY) == []


def test_a_joint_that_did_not_move_as_told_is_not_judged():
    odd = {**HEALTHY, "hip_fl": replace(HEALTHY["hip_fl"], followed=0.3)}
    assert "hip_fl: cannot judge its friction, because it went only 30 % of the way" in unjudged(HEALTHY, odd)[0]
    assert "not measured when the robot was healthy" in unjudged({}, HEALTHY)[0]
