"""What speaks for each cause: templates and healthy robots of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.assess import layouts_of
from openant_tools.gap.ensemble import robots_at, templates_at, templates_of
from openant_tools.gap.evidence import Scale, anomalies, evidence_of, unknown_signals
from openant_tools.gap.experiment import Experiment
from openant_tools.gap.population import Case
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.refine import refined
from openant_tools.recording.run import Facts, Run

PENDULUM = """
<mujoco model="pendulum"><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body pos="0 0 1"><inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>
    <joint name="hinge" axis="0 1 0" damping="0.03" armature="0.002" frictionloss="0.01"/></body></worldbody>
  <actuator><position name="hinge" joint="hinge" kp="1.5" forcerange="-0.5 0.5"/></actuator>
</mujoco>"""
#: two legs that stand apart, of two joints each
TWO_LEGS = """
<mujoco model="legs"><option timestep="0.002" integrator="implicitfast"/><worldbody>{}</worldbody><actuator>{}</actuator></mujoco>"""


def _recorded(model: Path, joints: tuple[str, ...], seconds: float, *, torque: bool = True) -> RunSet:
    """Runs of a robot that goes where it is told to, exactly."""
    runs = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, seconds, 0.01)
        columns = {}
        for joint in joints:
            hz, phase = rng.uniform(0.3, 1.5, 3), rng.uniform(0, 6, 3)
            command = 0.3 * np.sin(2 * np.pi * hz * t[:, None] + phase).sum(axis=1)
            columns[f"cmd.{joint}"] = command
            columns[f"pos.{joint}"] = np.round(command / 0.0015) * 0.0015
            columns[f"vel.{joint}"] = np.gradient(command, t)
            if torque:
                columns[f"cur.{joint}"] = 0.1 * np.sin(t)
        runs.append(Run(f"run{seed}", Facts(joints=joints, setup="stand"), t, columns))
    return Experiment.of(runs, model, joints).protocol.coarse()


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> RunSet:
    model = tmp_path_factory.mktemp("model") / "pendulum.xml"
    model.write_text(PENDULUM)
    return _recorded(model, ("hinge",), 4.0)


def _healthy(protocol: RunSet, count: int, first: int = 0) -> list[Case]:
    return [Case({}, seed) for seed in range(first, first + count)]


def _with(cause: str, count: int) -> list[Case]:
    """Robots at random that have one cause alone, clearly."""
    (only,) = catalogue()[cause].quantities
    sizes = np.geomspace(0.3, 1.0, count) * only.large
    return [Case({cause: ((0,), {only.name: float(size)})}, 700 + k) for k, size in enumerate(sizes)]


@pytest.fixture(scope="module")
def simulated(pendulum: RunSet) -> tuple[list[Case], NDArray[np.float32], NDArray[np.float32]]:
    """The bank, what it shows, and a few healthy robots."""
    bank = templates_of(pendulum)
    return (
        bank,
        _features(templates_at(pendulum, bank)),
        _features(robots_at(pendulum, _healthy(pendulum, 60), 1)),
    )


@pytest.mark.parametrize(("cause", "x"), [("torque_limit", -0.9), ("actuator_lag", 1.0), ("dead_zone", 1.0)])
def test_a_size_that_no_template_has_is_found_and_explains_the_rest(
    pendulum: RunSet,
    simulated: tuple[list[Case], NDArray[np.float32], NDArray[np.float32]],
    cause: str,
    x: float,
) -> None:
    (first, *others) = catalogue()[cause].quantities
    truth = {first.name: x * first.large, **{q.name: q.sought()[0] if q.shape else 0.0 for q in others}}
    seen = _features(templates_at(pendulum, [Case({cause: ((0,), truth)}, -1)]))[0]
    bank, templates, healthy = simulated
    known = np.concatenate([one.layout.known(one.seen) for one in pendulum.runs])

    def scale(bank: list[Case], templates: NDArray[np.float32]) -> Scale:
        return Scale.of(layouts_of(pendulum), known, healthy, templates, bank, pendulum.reference)

    def share(scale: Scale) -> float:
        """How much of what was seen the cause's best template explains."""
        z = scale.whitened(seen[None])
        fit = scale.templates.fits(z)[0][scale.templates.of_cause[scale.templates.causes.index(cause)]]
        return float(fit.max() / np.linalg.norm(z))

    before = scale(bank, templates)
    more, found = refined(before, seen, lambda cases: _features(templates_at(pendulum, cases)))
    after = scale([*bank, *more], np.concatenate([templates, found]))
    assert share(after) > max(0.97, share(before))
    name, _, at = after.templates.bank[int(np.argmax(after.templates.fits(after.whitened(seen[None]))[0]))]
    assert name == cause
    assert at[first.name] == pytest.approx(truth[first.name], rel=0.15)


def test_a_tolerance_takes_what_lies_within_it_and_no_more(
    pendulum: RunSet, simulated: tuple[list[Case], NDArray[np.float32], NDArray[np.float32]]
) -> None:
    """Gains three tolerances off were once taken for those of an unlikely robot of the same build."""
    bank, templates, healthy = simulated
    known = np.concatenate([one.layout.known(one.seen) for one in pendulum.runs])
    scale = Scale.of(layouts_of(pendulum), known, healthy, templates, bank, pendulum.reference)
    tolerance = catalogue()["stiffness_error"].quantities[0].tolerance
    cases = [Case({"stiffness_error": ((0,), {"scale": n * tolerance})}, -1) for n in (0.8, 3.0)]
    within, beyond = np.linalg.norm(scale.vectors(_features(templates_at(pendulum, cases))), axis=1)
    typical = np.median(np.linalg.norm(scale.whitened(healthy), axis=1))
    assert within < 0.3 * typical
    assert beyond > 3 * typical


def _features(parts: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate(parts, axis=1)


@pytest.mark.slow
def test_each_cause_is_among_the_first_by_what_it_would_do_to_this_very_recording(
    pendulum: RunSet, simulated: tuple[list[Case], NDArray[np.float32], NDArray[np.float32]]
) -> None:
    (bank, templates, healthy), layouts = simulated, layouts_of(pendulum)
    known = np.concatenate([one.layout.known(one.seen) for one in pendulum.runs])
    # Nothing was logged of the supply, and no block of it says anything.
    assert not known[layouts.signal == "volt"].any()
    scale = Scale.of(layouts, known, healthy, templates, bank, pendulum.reference)

    others = [evidence_of(scale, one) for one in _features(robots_at(pendulum, _healthy(pendulum, 20, 500), 2))]
    assert 0.5 < np.median([one.anomaly.size for one in others]) < 1.5, "a healthy robot differs as healthy ones do"

    # On a stand nothing tells a late command from a late reading, and little from a lag.
    late = {"action_delay", "sensor_delay", "actuator_lag"}
    for cause, alike in (
        ("stiffness_error", {"stiffness_error"}),
        ("action_delay", late),
        ("zero_offset", {"zero_offset"}),
    ):
        found = [evidence_of(scale, one) for one in _features(robots_at(pendulum, _with(cause, 6), 3))]
        first = [{one.causes[k] for k in np.argsort(-one.fit)[:3]} for one in found]
        assert sum(bool(alike & some) for some in first) >= 5, (cause, first)
        mine = found[0].causes.index(cause)
        assert np.median([one.fit[mine] for one in found]) > max(one.fit[mine] for one in others), cause
        assert all(one.anomaly.left < one.anomaly.size for one in found), "the best cause explains some of it"


def test_a_signal_in_which_no_robot_differs_says_nothing(pendulum: RunSet) -> None:
    """A supply that never sags, in whatever log it is."""
    rng = np.random.default_rng(0)
    layouts, bank = layouts_of(pendulum), templates_of(pendulum)[:8]
    still = layouts.signal == "volt"
    healthy, templates = (rng.normal(size=(n, len(still))).astype(np.float32) * ~still for n in (40, len(bank)))
    known = np.ones(len(still), bool)
    scale = Scale.of(layouts, known, healthy[:30], templates, bank, pendulum.reference)
    assert "volt" not in unknown_signals(scale, healthy[30:], healthy[0])
    found = anomalies(scale, healthy[30:], healthy[0])
    assert "volt" not in found
    assert np.isfinite(list(found.values())).all()


def test_on_a_stand_legs_that_do_not_move_each_other_are_simulated_side_by_side(tmp_path: Path) -> None:
    leg = (
        '<body pos="0 {y} 1"><inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>'
        '<joint name="{n}_hip" axis="0 1 0" damping="0.03" armature="0.002"/><body pos="0 0 -0.2"><inertial pos="0 0 -0.1" '
        'mass="0.05" diaginertia="1e-4 1e-4 1e-5"/><joint name="{n}_knee" axis="0 1 0" damping="0.03" armature="0.002"/></body></body>'
    )
    joints = ("a_hip", "a_knee", "b_hip", "b_knee")
    drives = "".join(f'<position name="{one}" joint="{one}" kp="2" forcerange="-1 1"/>' for one in joints)
    model = tmp_path / "legs.xml"
    model.write_text(TWO_LEGS.format(leg.format(n="a", y=0) + leg.format(n="b", y=1), drives))
    protocol = _recorded(model, joints, 1.5)
    bank = [
        case for case in templates_of(protocol)
        for name, (at, _x) in case.causes.items() if len(at) == 1 and name in {"stiffness_error", "backlash", "zero_offset"}
    ]  # fmt: skip
    side_by_side = _features(templates_at(protocol, bank))
    alone = np.concatenate([_features(templates_at(protocol, [case])) for case in bank])
    # The scale of torques is asked of all joints at once.
    layouts = layouts_of(protocol)
    means = np.isin(layouts.signal, ["pos", "vel"])
    np.testing.assert_allclose(side_by_side[:, means], alone[:, means], atol=2e-5)
