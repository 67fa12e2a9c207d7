"""First looks at causes: which of them would leave less where the best suspect sits, and where a suspect sits."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from plants import SERVO, drive, pendulum, run_of, sweep, write

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Robot
from openant_tools.gap.closure import Windows, closures, nothing, unmoved
from openant_tools.gap.explain import Explained, Part, Scene, known_to
from openant_tools.gap.features import Floats
from openant_tools.gap.judge import Judgement
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.rivals import bodily, paired, placed, resized, rivals, told, unexpected
from openant_tools.gap.simulation import simulate
from openant_tools.gap.whitening import Metric
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.mjcf import nominal_mjcf

T = 2.0 + np.arange(150) / 50


def suspect(cause: str, joints: tuple[int, ...], strength: float) -> Explained:
    x = catalogue()[cause].starts(strength)[0]
    return Explained(Part(cause, joints), x, dict.fromkeys(x, 0.1), 1.0)


def sized(cause: str, value: float) -> Explained:
    (quantity,) = catalogue()[cause].quantities
    return dataclasses.replace(suspect(cause, (0,), 0.5), x={quantity.name: quantity.back(value, 1.0)})


def windows_of(folder: Path, stiffness: float) -> Windows:
    """A servo of this stiffness that gives 0.6 N·m, of a model with 8 N·m/rad that lets it give 1.5."""
    robot, model = (
        write(folder / f"{limit}.xml", pendulum(f'<position {SERVO} kp="{kp}" forcerange="-{limit} {limit}"/>'))
        for kp, limit in ((stiffness, 0.6), (8, 1.5))
    )
    plant = load_plant(robot)
    runs = [
        run_of(
            drive(plant.model, ["joint"], T, 0.6 * sweep(T, 1, reach=reach), noise=3e-4), T, ["joint"], f"run-{reach}"
        )
        for reach in (0.6, 0.9)
    ]
    windows = Windows(Protocol.of(runs, model, ["joint"], [None, None]))
    closures(windows, [nothing(windows)], (), [0, 1])
    return windows


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> Windows:
    return windows_of(tmp_path_factory.mktemp("weak"), 8)


def test_what_nobody_suspected_is_found_where_the_best_suspect_sits(weak: Windows) -> None:
    found = rivals(weak, [suspect("viscous_nonlinear", (0,), 0.5)], ["viscous_nonlinear"], [0, 1])
    assert "torque_limit" in [part.cause for part in found]
    assert all(part.joints == (0,) for part in found)


def test_nothing_rivals_the_cause_itself(weak: Windows) -> None:
    assert rivals(weak, [sized("torque_limit", 0.4)], ["torque_limit"], [0, 1]) == {}


def test_a_suspect_is_put_where_the_runs_say(weak: Windows) -> None:
    """Of sizes that the judge and the fit to features name, the runs choose."""
    one = suspect("torque_limit", (0,), 0.0)
    near = {"limit": float(np.log(0.4))}
    places: list[tuple[tuple[int, ...], dict[str, float]]] = [((0,), {"limit": float(np.log(0.9))}), ((0,), near)]
    judgement = Judgement({}, np.zeros(1), {"torque_limit": places})
    there, cost = placed(weak, judgement, {"torque_limit": one}, [0, 1])["torque_limit"]
    assert there.x == near
    unnamed = Judgement({}, np.zeros(1), {"torque_limit": []})
    assert cost < placed(weak, unnamed, {"torque_limit": one}, [0, 1])["torque_limit"][1]


def test_a_second_cause_is_looked_for_beside_the_first_and_not_where_there_is_none(
    weak: Windows, tmp_path: Path
) -> None:
    first, others = sized("torque_limit", 0.4), [sized("stiffness_error", 2.0), suspect("backlash", (0,), 0.8)]
    assert paired(weak, first, others, [0, 1]) == []
    found = paired(windows_of(tmp_path, 16), first, others, [0, 1])
    assert [one.part.cause for one, _ in found] == ["stiffness_error"]
    assert found[0][1] < 0.7


def test_beside_the_best_what_had_neither_size_nor_place_alone_is_tried_where_the_best_sits(
    weak: Windows, tmp_path: Path
) -> None:
    first, vanished = sized("torque_limit", 0.4), sized("stiffness_error", 1.01)
    assert paired(weak, first, [vanished], [0, 1]) == []
    ((found, left),) = paired(windows_of(tmp_path, 16), first, [vanished], [0, 1])
    assert found.part == Part("stiffness_error", (0,))
    assert found.x["scale"] > 10 * vanished.x["scale"]
    assert left < 0.7


def on_the_stand(folder: Path, robot: Robot, *, warmer_c: float = 0.0) -> Windows:
    """Two runs of an Ant whose legs hang free, its servos in the second this much warmer than in the first."""
    plant = load_plant(write(folder / "given.xml", nominal_mjcf("standard")), None, Setup.STAND)
    home = np.array([0.0 if joint.startswith("hip") else -0.6 for joint in plant.joints])
    runs = []
    for n in range(2):
        commands = home + 0.5 * np.sin(2 * np.pi * (1.5 + n) * (T - T[0])[:, None] + np.arange(8))
        columns = {f"cmd.{joint}": commands[:, j] for j, joint in enumerate(plant.joints)}
        columns |= {f"pos.{joint}": np.full(len(T), home[j]) for j, joint in enumerate(plant.joints)}
        columns |= {f"temp.{joint}": np.full(len(T), 25.0 + n * warmer_c) for joint in plant.joints}
        run = Run(f"run-{n}", Facts(joints=plant.joints, setup="stand"), T, columns)
        warm_c = [np.full(len(plant.joints), n * warmer_c)]
        found = simulate(Rollouts(plant, [run]), [robot], signals=["pos"], warm_c=warm_c)
        seen = found.signals["pos"][0].astype(float)
        columns |= {f"pos.{joint}": seen[:, j] for j, joint in enumerate(plant.joints)}
        runs.append(dataclasses.replace(run, columns=columns))
    return Windows(Protocol.of(runs, plant.path, plant.joints, [None, None]))


def test_a_joint_that_is_strained_is_asked_whatever_the_judge_says(tmp_path: Path) -> None:
    """One hip of the Ant brakes three times as much as the others; the judge knows of all joints alone."""
    robot = Robot(8)
    robot.factor("damping")[2] = 3.0
    windows = on_the_stand(tmp_path, robot)
    windows.refit([nothing(windows)], [0, 1], ())
    assert windows.strained([0, 1]) == [2]
    everywhere = suspect("damping_error", tuple(range(8)), 0.6)
    judgement = Judgement({}, np.zeros(1), {"damping_error": [(everywhere.part.joints, dict(everywhere.x))]})
    one, _ = placed(windows, judgement, {"damping_error": everywhere}, [0, 1])["damping_error"]
    assert one.part.joints == (2,)
    # Among eight joints two causes at one of them are hard to tell apart; at that one they are not.
    other = suspect("link_mass", (2,), 0.6)
    starts = [unmoved(windows, [each.part], [each.x]) for each in (one, other)]
    _, _, (brakes, heavy) = closures(windows, starts, [1], [0])
    assert brakes.closed_at([2]) - heavy.closed_at([2]) > brakes.closed - heavy.closed > 0
    assert brakes.closed_at(range(8)) == pytest.approx(brakes.closed)


def test_what_warm_servos_lose_is_tried_in_sizes_that_no_template_has(tmp_path: Path) -> None:
    """Templates know not how warm this robot was: the judge names another joint, and a size that is next to nothing."""
    robot = Robot(8)
    robot.derating[2] = 0.03
    windows = on_the_stand(tmp_path, robot, warmer_c=25.0)
    windows.refit([nothing(windows)], [0, 1], ())
    assert windows.strained([0, 1]) == [2]
    named = suspect("thermal_derating", (5,), 0.0)
    judgement = Judgement({}, np.zeros(1), {"thermal_derating": [(named.part.joints, dict(named.x))]})
    there, cost = placed(windows, judgement, {"thermal_derating": named}, [0, 1])["thermal_derating"]
    assert there.part.joints == (2,)
    assert there.x["loss_per_c"] == pytest.approx(0.03, rel=0.3)
    assert cost < 0.5 * windows.left([unmoved(windows, [named.part], [named.x])], [0, 1])[0]


def test_of_other_sizes_the_runs_choose_the_one_that_leaves_least(weak: Windows) -> None:
    """A size near its own is not tried again."""
    far = sized("torque_limit", 0.95)
    (found,) = resized(weak, [far], [0, 1])
    tried = [x["limit"] for strength in (0.3, 0.7) for x in catalogue()["torque_limit"].starts(strength)]
    assert found.x["limit"] in tried
    costs = weak.left([unmoved(weak, [far.part], [{"limit": x}]) for x in tried], [0, 1])
    assert found.x["limit"] == tried[int(np.argmin(costs))]
    (other,) = resized(weak, [found], [0, 1])
    assert other.x != found.x


def test_a_second_cause_is_put_where_it_sits_beside_the_first(tmp_path: Path) -> None:
    """Alone it was found at the hips, since the first was in its way."""
    robot, everywhere = Robot(8), tuple(range(8))
    robot.factor("stiffness")[:] *= 0.5
    robot.more("coulomb_friction")[:] += 0.1
    windows = on_the_stand(tmp_path, robot)
    windows.look([0, 1])
    first = dataclasses.replace(sized("stiffness_error", 0.5), part=Part("stiffness_error", everywhere))
    found = paired(windows, first, [suspect("coulomb_friction", (0, 2, 4, 6), 0.5)], [0, 1])
    assert [one.part for one, _ in found] == [Part("coulomb_friction", everywhere)]


def test_an_expected_second_cause_is_tried_where_the_judge_sees_it_once_it_knows_the_first(tmp_path: Path) -> None:
    """Alone it was found at the first one's joint, which hid its own; in what that leaves the judge sees where it is."""
    robot = Robot(8)
    robot.factor("stiffness")[4] *= 0.4
    robot.delay[1] += 0.03
    windows = on_the_stand(tmp_path, robot)
    windows.refit([nothing(windows)], [0, 1], ())
    first = dataclasses.replace(sized("stiffness_error", 0.4), part=Part("stiffness_error", (4,)))
    hidden = suspect("action_delay", (4,), 0.5)
    ((near, wider),) = paired(windows, first, [hidden], [0, 1])
    assert near.part.joints == (1, 3, 5, 7), "of all places that nobody names the nearest"
    judgement = Judgement({}, 1.0, {"action_delay": [((1,), dict(suspect("action_delay", (1,), 0.5).x))]})
    elsewhere = told(windows, judgement, ["action_delay"], [0, 1])
    assert {one.part.joints for one in elsewhere} == {(1,), *((j,) for j in windows.strained([0, 1]))}
    ((found, share),) = paired(windows, first, [hidden], [0, 1], elsewhere)
    assert found.part == Part("action_delay", (1,))
    assert share < wider


def test_what_acts_beside_the_first_is_found_though_nobody_suspects_it(tmp_path: Path) -> None:
    robot, hips = Robot(8), (0, 2, 4, 6)
    robot.factor("stiffness")[:] *= 0.5
    robot.delay[::2] += 0.06
    windows = on_the_stand(tmp_path, robot)
    windows.look([0, 1])
    first = dataclasses.replace(sized("stiffness_error", 0.5), part=Part("stiffness_error", tuple(range(8))))
    found = unexpected(windows, first, ["stiffness_error"], [hips, tuple(range(8))], [0, 1])
    best, share = min(found, key=lambda pair: pair[1])
    # Late and slow are much alike in the few sizes of a first look.
    assert (best.part.cause in {"action_delay", "actuator_lag"}, best.part.joints) == (True, hips)
    assert share < 0.7
    assert unexpected(windows, first, list(catalogue()), [hips], [0, 1]) == []


class Everything:
    """A measure in which all features count as they are."""

    def __call__(self, x: Floats) -> Floats:
        return x


def test_what_windows_alone_found_is_known_as_well_as_the_runs_let_it_be(tmp_path: Path) -> None:
    protocol = on_the_stand(tmp_path, Robot(8)).protocol
    seen = np.concatenate([one[0] for one in protocol.features()])
    scene = Scene(protocol, protocol.runs, Metric(cast(Any, Everything()), np.ones(len(seen), bool)), seen)
    found = dataclasses.replace(suspect("coulomb_friction", (0, 2, 4, 6), 0.5), std={"torque_nm": 0.0})
    known = known_to(scene, found)
    assert 0 < known.std["torque_nm"] < np.inf
    assert (known.part, known.x) == (found.part, found.x)


def test_what_one_joint_does_is_not_lost_among_what_others_do(tmp_path: Path) -> None:
    """A knee brakes a little more than it should, while all hips are far stiffer: where the knee alone counts, that is seen."""
    robot = Robot(8)
    robot.factor("stiffness")[::2] = 2.5
    robot.factor("damping")[3] = 1.35
    windows = on_the_stand(tmp_path, robot)
    windows.look([0, 1])
    braked = suspect("damping_error", (3,), 0.0)
    braked = dataclasses.replace(braked, x={"scale": float(np.log(1.35))})
    refits = [unmoved(windows, [], []), unmoved(windows, [braked.part], [braked.x])]
    everywhere, here = (windows.left(refits, [0, 1], joints) for joints in (None, [3]))
    assert here[1] / here[0] < 0.5 * everywhere[1] / everywhere[0]
    assert (here < everywhere).all()


def test_causes_of_the_body_are_asked_where_there_is_a_floor(weak: Windows, tmp_path: Path) -> None:
    assert bodily(weak.protocol, ()) == []
    on_floor = dataclasses.replace(weak.protocol, reference=dataclasses.replace(weak.protocol.reference, floor=True))
    names = [one.part.cause for one in bodily(on_floor, ["payload"])]
    assert {"foot_adhesion", "contact_softness", "floor_tilt"} <= set(names)
    assert not {"payload", "imu_bias", "zero_offset"} & set(names)
