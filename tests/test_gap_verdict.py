"""What evidence makes a verdict: told to it by hand, since the simulations that give it are tested elsewhere."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
import pytest

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap import verdict as of_verdict
from openant_tools.gap.closure import ClosureByJoint, Refit
from openant_tools.gap.explain import Explained, Part
from openant_tools.gap.judge import Judgement
from openant_tools.gap.patient import Patient
from openant_tools.gap.verdict import _Chosen, _Evidence, _Leader, _led, _plain, _taken_in, _told_apart, _verdict


class Builder:
    """A patient of whom nothing is known but what its builder declared."""

    declared = Patient.declared

    def __init__(self, *prior: str) -> None:
        self.prior = prior
        self.refuted: dict[str, str] = {}


def evidence(*prior: str, **suspects: tuple[float, float]) -> _Evidence:
    """Suspects with their probability and the share of the gap that each closes by itself; prior: what is declared."""
    nothing, patient = cast(Any, None), cast(Any, Builder(*prior))

    def closure(closed: float, *names: str) -> ClosureByJoint:
        parts, sizes = [Part(name, (0,)) for name in names], [catalogue()[name].starts(0.5)[0] for name in names]
        refit = Refit(tuple(parts), tuple(sizes), np.zeros(0))
        joints = np.array([[1.0], [(1 - closed) ** 2]])
        return ClosureByJoint(1 - closed, closed, closed, closed, closed, refit, joints, 0.0)

    return _Evidence(
        patient, Judgement({}, 5.0, {}), {}, nothing, [], {name: chance for name, (chance, _) in suspects.items()},
        {name: Explained(Part(name, (0,)), catalogue()[name].starts(0.5)[0], {}, 1.0) for name in suspects},
        {name: closure(closed, name) for name, (_, closed) in suspects.items()}, closure(0.1), 1.0, 0.0, [0],
    )  # fmt: skip


@pytest.mark.parametrize("likelier", [0.66, 0.06])
def test_of_causes_that_look_alike_the_one_that_closes_more_is_believed(likelier: float) -> None:
    found = evidence(foot_adhesion=(0.66, 0.72), floor_friction=(0.06, 0.75))
    _told_apart(found)
    assert found.names[0] == "floor_friction"
    assert found.probability == {"foot_adhesion": 0.06, "floor_friction": 0.66}
    found = evidence(foot_adhesion=(likelier, 0.86), floor_friction=(0.72 - likelier, 0.76))
    _told_apart(found)
    assert found.names[0] == "foot_adhesion"
    assert found.probability["foot_adhesion"] == pytest.approx(0.66)


@pytest.mark.parametrize(
    ("adhesion", "friction"),
    [((0.9, 0.2), (0.1, 0.3)), ((0.9, 0.80), (0.1, 0.805))],
    ids=["neither closes much", "they close as much"],
)
def test_where_windows_do_not_tell_them_apart_the_judge_does(
    adhesion: tuple[float, float], friction: tuple[float, float]
) -> None:
    found = evidence(foot_adhesion=adhesion, floor_friction=friction)
    _told_apart(found)
    assert found.probability == {"foot_adhesion": 0.9, "floor_friction": 0.1}


def test_what_looks_unlike_keeps_what_the_judge_gave_it() -> None:
    found = evidence(foot_adhesion=(0.9, 0.5), payload=(0.1, 0.9))
    _told_apart(found)
    assert found.probability == {"foot_adhesion": 0.9, "payload": 0.1}


def test_looking_alike_is_mutual() -> None:
    for name, cause in catalogue().items():
        assert all(name in catalogue()[twin].alike for twin in cause.alike)


@pytest.mark.parametrize(
    ("jitter", "dropout", "leads"),
    [(0.93, 0.92, "command_dropout"), (0.9, 0.3, "clock_jitter"), (0.4, 0.6, "command_dropout")],
)
def test_lost_commands_are_late_ones_too_and_not_the_other_way_round(jitter: float, dropout: float, leads: str) -> None:
    found = evidence(clock_jitter=(jitter, 0.1), command_dropout=(dropout, 0.1))
    _taken_in(found)
    assert found.names[0] == leads
    assert list(found.patient.refuted) == (["clock_jitter"] if min(jitter, dropout) > 0.5 else [])


def of_healthy_build(chance: float, closed: float, plain: float, energy: float, floor: float) -> _Evidence:
    found = evidence(stribeck_friction=(chance, closed))
    without = dataclasses.replace(evidence(payload=(0.1, plain)).alone["payload"], refit=found.plain.refit)
    return dataclasses.replace(found, judgement=Judgement({}, energy, {}), plain=without, floor=floor)


@pytest.mark.parametrize(("chance", "believed"), [(0.97, 0.97), (0.7, 0.0)])
def test_what_tolerances_do_as_well_is_nothing_unless_it_is_certain(
    monkeypatch: pytest.MonkeyPatch, chance: float, believed: float
) -> None:
    monkeypatch.setattr(of_verdict, "_without", lambda found, name: Judgement({}, 1.0, {}))
    found = of_healthy_build(chance, closed=0.78, plain=0.79, energy=1.9, floor=0.1)
    _led(found, found.names)
    assert found.probability["stribeck_friction"] == pytest.approx(believed)


@pytest.mark.parametrize(("energy", "floor", "proved"), [(1.2, 0.2, False), (5.0, 0.2, True), (1.2, 0.1, True)])
def test_a_third_of_what_healthy_robots_leave_proves_nothing(
    monkeypatch: pytest.MonkeyPatch, energy: float, floor: float, proved: bool
) -> None:
    monkeypatch.setattr(of_verdict, "_without", lambda found, name: Judgement({}, 1.0, {}))
    monkeypatch.setattr(of_verdict, "nothing", lambda windows: found.plain.refit)
    monkeypatch.setattr(_Evidence, "closures", lambda found, starts: (1.0, floor, [found.plain]))
    found = of_healthy_build(0.05, closed=0.66, plain=0.5, energy=energy, floor=floor)
    assert _led(found, found.names).proved is proved


def verdict_of(found: _Evidence, leads: str) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    names = sorted(found.explained, key=lambda name: name != leads)
    leader = _Leader(leads, gained=0.7, beside=False, proved=True, left=None, eased=False)
    return _verdict(found, names, leader, _Chosen((leads,), found.alone[leads], {leads: 0.7}))


def test_what_runs_cannot_tell_apart_is_ambiguous_unless_one_of_it_was_declared() -> None:
    suspects = {"torque_limit": (0.9, 0.80), "weak_joint": (0.8, 0.805), "payload": (0.1, 0.2)}
    pair = ("torque_limit", "weak_joint")
    assert verdict_of(evidence(**suspects), "torque_limit") == ("ambiguous", ("torque_limit",), (pair,))
    assert verdict_of(evidence("torque_limit", **suspects), "torque_limit") == (
        "torque_limit",
        ("torque_limit",),
        (pair,),
    )
    # What was declared otherwise has to lead first; what is told apart, or all of it declared, needs no prior.
    for prior in (["weak_joint"], ["payload"], list(pair)):
        assert verdict_of(evidence(*prior, **suspects), "torque_limit")[0] == "ambiguous"
    assert verdict_of(evidence("weak_joint", **suspects), "weak_joint")[0] == "weak_joint"
    clear = {**suspects, "weak_joint": (0.8, 0.5)}
    assert verdict_of(evidence("weak_joint", **clear), "torque_limit") == ("torque_limit", ("torque_limit",), ())


def test_causes_that_look_alike_are_ambiguous_however_sure_the_judge_is() -> None:
    found = evidence(foot_adhesion=(0.9, 0.80), floor_friction=(0.05, 0.795))
    assert verdict_of(found, "foot_adhesion")[2] == (("foot_adhesion", "floor_friction"),)
    found = evidence(foot_adhesion=(0.9, 0.80), payload=(0.05, 0.795))
    assert verdict_of(found, "foot_adhesion")[0] == "foot_adhesion"


def test_a_first_look_is_plain_where_one_cause_leaves_far_less_than_the_others() -> None:
    def look(**shares: float) -> list[tuple[Explained, float]]:
        return [(Explained(Part(name, (0,)), {}, {}, 1.0), share) for name, share in shares.items()]

    assert _plain([]) is None
    assert _plain(look(backlash=0.8)) is None
    assert _plain(look(backlash=0.5)) == Part("backlash", (0,))
    assert _plain(look(cogging=0.9, backlash=0.5)) == Part("backlash", (0,))
    assert _plain(look(cogging=0.6, backlash=0.5)) is None


def test_two_causes_that_the_judge_was_sure_of_are_no_riddle_whatever_they_leave() -> None:
    found = evidence(cogging=(0.99, 0.5), floor_tilt=(0.9, 0.3))
    leader = _Leader("cogging", gained=0.1, beside=False, proved=False, left=None, eased=False)
    both = _Chosen(("cogging", "floor_tilt"), found.alone["cogging"], {"cogging": 0.1, "floor_tilt": 0.0}, energy=30.0)
    found.ranked = [("cogging", 0.99), ("floor_tilt", 0.9)]
    assert _verdict(found, ["cogging", "floor_tilt"], leader, both)[:2] == ("cogging", ("cogging", "floor_tilt"))
    found.ranked = [("cogging", 0.99), ("floor_tilt", 0.1)]
    assert _verdict(found, ["cogging", "floor_tilt"], leader, both)[0] == "unexplained"


@pytest.mark.parametrize(
    ("chance", "beside", "said"),
    [(0.98, 0.45, "command_dropout"), (0.7, 0.45, "unexplained"), (0.98, None, "command_dropout")],
    ids=["certain, with another", "likely", "certain, alone"],
)
def test_what_a_certain_random_cause_leaves_is_no_riddle(chance: float, beside: float | None, said: str) -> None:
    """Commands that are lost at random leave a robot as odd as it was: no simulation loses the same ones."""
    found = evidence(command_dropout=(chance, 0.1), zero_offset=(beside or 0.1, 0.15))
    found.ranked, left = list(found.probability.items()), Judgement({}, 21.0, {})
    leader = _Leader("command_dropout", gained=0.0, beside=False, proved=False, left=left, eased=False)
    names = ("command_dropout", "zero_offset") if beside else ("command_dropout",)
    chosen = _Chosen(names, found.alone[names[-1]], dict.fromkeys(names, 0.03), energy=21.0)
    verdict, selected, _ = _verdict(found, ["command_dropout", "zero_offset"], leader, chosen)
    assert (verdict, set(selected)) == (said, set(names) if said != "unexplained" else set())


def test_what_is_hardly_believed_does_not_lead_before_what_is_certain_and_closes_more() -> None:
    """Where suspects are compared at one joint alone, something there may close more than what acts on all."""
    found = evidence(dead_zone=(0.1, 0.30), cogging=(1.0, 0.40))
    for name, share in (("dead_zone", 0.9), ("cogging", 0.2)):
        closure = found.alone[name]
        joints = np.hstack([np.array([[1.0], [(1 - share) ** 2]]), closure.joints])
        found.alone[name] = dataclasses.replace(closure, joints=joints)
    assert found.score("dead_zone") > found.score("cogging"), "at the joint where suspects are compared"
    assert found.names[0] == "cogging"
    found.probability["dead_zone"] = 0.6
    assert found.names[0] == "dead_zone"
    found.probability |= {"dead_zone": 0.1, "cogging": 0.7}
    assert found.names[0] == "dead_zone"


def leads(name: str, gained: float, left: float, *, beside: bool = False) -> _Leader:
    return _Leader(name, gained, beside, proved=False, left=Judgement({}, left, {}), eased=False)


@pytest.mark.parametrize(("left", "said"), [(25.0, "unexplained"), (5.0, "stribeck_friction")])
def test_what_takes_nothing_away_has_no_part_in_a_riddle(left: float, said: str) -> None:
    """A re-fit closed what was closed, whatever the judge is sure of."""
    found = dataclasses.replace(
        evidence(stribeck_friction=(0.98, 0.6)), judgement=Judgement({}, 25.0, {}), ranked=[("stribeck_friction", 0.98)]
    )
    chosen = _Chosen(("stribeck_friction",), found.alone["stribeck_friction"], {"stribeck_friction": 0.0}, energy=25.0)
    assert _verdict(found, ["stribeck_friction"], leads("stribeck_friction", 0.0, left), chosen)[0] == said


@pytest.mark.parametrize(
    ("other", "said"), [("imu_misalignment", "unexplained"), ("zero_offset", "imu_bias")], ids=["senses", "a joint"]
)
def test_what_only_senses_show_is_no_reason_for_joints_to_stray(other: str, said: str) -> None:
    found = evidence(**{"imu_bias": (0.9, 0.01), other: (0.8, 0.01)})
    found.ranked = list(found.probability.items())
    chosen = _Chosen(("imu_bias", other), found.alone[other], {"imu_bias": 0.02, other: 0.01}, energy=180.0)
    assert _verdict(found, ["imu_bias", other], leads("imu_bias", 0.0, 190.0, beside=True), chosen)[0] == said


@pytest.mark.parametrize(("closed", "said"), [(0.5, "unexplained"), (0.6, "zero_offset")])
def test_half_of_a_huge_gap_is_no_explanation_of_a_robot_that_stays_strange(closed: float, said: str) -> None:
    """A foot that came off is a shorter leg, and an offset of its joints does half of what it does."""
    found = evidence(zero_offset=(0.93, closed))
    chosen = _Chosen(("zero_offset",), found.alone["zero_offset"], {"zero_offset": 0.3}, energy=4.5)
    assert _verdict(found, ["zero_offset"], leads("zero_offset", 0.3, 4.5, beside=True), chosen)[0] == said


@pytest.mark.parametrize(
    ("energy", "sure", "said"),
    [(1.4, 0.97, "action_delay"), (1.4, 0.7, "none"), (0.9, 0.97, "none"), (4.0, 0.7, "action_delay")],
)
def test_where_the_judge_is_sure_of_something_fits_may_say_which_it_is(energy: float, sure: float, said: str) -> None:
    """A delay that a judge takes for a lag closes what the lag does not."""
    found = evidence(action_delay=(0.1, 0.74), actuator_lag=(sure, 0.47))
    found = dataclasses.replace(found, judgement=Judgement({}, energy, {}), floor=0.2)
    leader = _Leader("action_delay", gained=0.1, beside=False, proved=False, left=None, eased=False)
    chosen = _Chosen(("action_delay",), found.alone["action_delay"], {"action_delay": 0.6}, energy=0.9)
    assert _verdict(found, ["action_delay", "actuator_lag"], leader, chosen)[0] == said


@pytest.mark.parametrize(("chance", "said"), [(0.98, "cable_drag"), (0.7, "unexplained")])
def test_joints_that_move_away_refute_what_carries_the_robot_unless_it_is_certain(chance: float, said: str) -> None:
    found = evidence(cable_drag=(chance, 0.78))
    found = dataclasses.replace(
        found, judgement=Judgement({}, 2.4, {}), plain=dataclasses.replace(found.plain, closed=0.87)
    )
    leader = _Leader("cable_drag", gained=-0.09, beside=True, proved=False, left=None, eased=False)
    chosen = _Chosen(("cable_drag",), found.alone["cable_drag"], {"cable_drag": -0.09}, energy=2.0)
    assert _verdict(found, ["cable_drag"], leader, chosen)[0] == said


@pytest.mark.parametrize(
    ("expected", "adds", "first"), [(0.1, 0.05, "link_mass"), (0.4, 0.05, "payload"), (0.1, 0.2, "payload")]
)
def test_what_shows_only_in_what_a_certain_cause_leaves_does_not_come_first(
    expected: float, adds: float, first: str
) -> None:
    found = evidence(link_mass=(0.95, 0.77), payload=(0.51, 0.79))
    found.ranked = [("link_mass", 0.95), ("payload", expected)]
    leader = _Leader("link_mass", gained=0.6, beside=False, proved=False, left=Judgement({}, 1.0, {}), eased=False)
    chosen = _Chosen(("link_mass", "payload"), found.alone["payload"], {"link_mass": 0.0, "payload": adds})
    assert _verdict(found, ["link_mass", "payload"], leader, chosen)[0] == first
