"""The diagnosis, end to end, on a robot of one joint that MuJoCo itself plays."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from plants import BENCH, COARSE, ENCODER_RAD, drive, pendulum, run_of, sweep, write
from threadpoolctl import threadpool_info, threadpool_limits

from openant_tools.errors import BadInput
from openant_tools.files import json_text
from openant_tools.gap.cache import cache_folder, code
from openant_tools.gap.diagnose import diagnose
from openant_tools.gap.diagnosis import NONE, UNEXPLAINED, Diagnosis, Found, Span, read_diagnosis
from openant_tools.gap.words import sentence, sizes, standing
from openant_tools.recording.run import Run

RATE_HZ = 50


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    patch = pytest.MonkeyPatch()
    patch.setenv("OPENANT_CACHE", str(tmp_path_factory.mktemp("cache")))


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "pendulum.xml", pendulum(option=COARSE))


def recorded(text: str, late_s: float = 0.0) -> list[Run]:
    """Three motions of a robot of this MJCF whose commands come late."""
    # On a stand nothing of the robot touches the world (formats, section 1).
    robot = mujoco.MjModel.from_xml_string(text.replace(BENCH, ""))
    robot.opt.timestep = 0.0005
    runs = []
    for k, (reach, fast) in enumerate([(0.6, 2.5), (0.9, 1.5), (0.35, 3.5)]):
        t = 3.0 + np.arange(round(1.3 * RATE_HZ)) / RATE_HZ
        command = sweep(t, 1, reach=reach, high_hz=fast)
        # Late by whole rows: what acts is an older command than what is logged.
        rows = round(late_s * RATE_HZ)
        shifted = np.concatenate([np.repeat(command[:1], rows, axis=0), command[: len(t) - rows]])
        columns = drive(robot, ["joint"], t, shifted, noise=5e-4, quantum=ENCODER_RAD, seed=k)
        columns["cmd.joint"] = command[:, 0]
        runs.append(run_of(columns, t, ["joint"], f"motion-{k}"))
    return runs


@pytest.fixture(scope="module")
def late(model: Path) -> Diagnosis:
    """The diagnosis of the robot whose commands come late."""
    return diagnose(recorded(pendulum(), late_s=0.04), model, recall=True)


def test_a_robot_within_tolerance_is_healthy(model: Path) -> None:
    found = diagnose(recorded(pendulum(joint='damping="0.128" armature="0.0063" frictionloss="0.035"')), model)
    assert found.verdict == NONE
    assert found.selected == ()


def test_late_commands_are_named_and_close_the_gap(late: Diagnosis) -> None:
    found = late
    # On positions alone a late command is a late sensor (effects.md).
    names = {found.effects[0].effect, found.effects[1].effect}
    assert names & {"action_delay", "sensor_delay"}
    assert found.verdict != NONE
    assert found.gap["before"] > 3 * found.gap["floor"]
    assert found.gap["floor_from"] == "sensors", "nobody repeated a motion"
    assert found.gap["after"] < 0.5 * found.gap["before"]
    assert {one["signal"]: one["finding"] for one in found.sensors}["pos"] == "as_modelled"
    assert sum(place["share"] for place in found.where if place["signal"] == "pos") == pytest.approx(1, abs=0.01)


def test_neither_the_order_in_which_runs_are_named_nor_what_is_kept_of_them_matters(
    model: Path, few_causes: None
) -> None:
    runs = recorded(pendulum(), late_s=0.04)[:2]
    first = diagnose(runs, model)
    assert len(first.effects) == 2
    other = diagnose(runs[::-1], model)  # what is kept from the first time serves this one
    assert other.runs == first.runs[::-1]
    assert other.as_json() == first.as_json() | {"runs": list(other.runs)}
    for one, same in zip(first.effects, other.effects, strict=True):
        assert same.effect == one.effect
        assert same.probability == pytest.approx(one.probability, abs=1e-6)
    assert other.gap["after"] == pytest.approx(first.gap["after"], rel=1e-3)


def test_what_was_asked_before_is_answered_as_before(
    model: Path, late: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work_it_out(*_: object) -> None:
        raise InterruptedError

    monkeypatch.setattr("openant_tools.gap.diagnose.hypotheses", work_it_out)
    runs = recorded(pendulum(), late_s=0.04)
    (place,) = cache_folder().glob("diagnosis-*.json")
    kept = place.read_text()
    assert json_text(diagnose(runs, model, recall=True).as_json()) == json_text(late.as_json())
    assert kept == json_text(late.as_json())

    def is_worked_out(runs: list[Run], **more: Any) -> None:
        with pytest.raises(InterruptedError):
            diagnose(runs, model, **{"recall": True, **more})

    is_worked_out(runs, recall=False)
    is_worked_out(runs, prior=["backlash"])
    is_worked_out(runs[:2], hold_out=runs[2:])
    changed = dict(runs[0].columns, **{"pos.joint": runs[0].columns["pos.joint"] + 1e-6})
    is_worked_out([dataclasses.replace(runs[0], columns=changed), *runs[1:]])
    for spoilt in ("", "{}", kept[:-100]):
        place.write_text(spoilt)
        is_worked_out(runs)
    place.write_text(kept)
    monkeypatch.setattr("openant_tools.gap.cache.COMPUTE", ("numpy",))
    code.cache_clear()
    is_worked_out(runs)
    monkeypatch.undo()
    code.cache_clear()
    monkeypatch.setattr("openant_tools.gap.diagnose.hypotheses", work_it_out)
    assert json_text(diagnose(runs, model, recall=True).as_json()) == json_text(late.as_json())
    text = model.read_text()
    try:
        model.write_text(text.replace('frictionloss="0.03"', 'frictionloss="0.031"'))
        is_worked_out(runs)
    finally:
        model.write_text(text)


def test_sums_are_rounded_alike_on_any_number_of_cores(model: Path) -> None:
    threads = set[int]()

    def look(share: float, words: str) -> None:
        threads.update(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")
        raise InterruptedError

    with threadpool_limits(2, "blas"), pytest.raises(InterruptedError):
        diagnose(recorded(pendulum()), model, progress=look)
    assert threads == {1}


def test_bad_input_is_one_line(model: Path) -> None:
    runs = recorded(pendulum())
    with pytest.raises(BadInput, match="only held-out runs"):
        diagnose([], model, hold_out=runs[:1])
    with pytest.raises(BadInput, match="the same as motion-0"):
        diagnose(runs, model, hold_out=[runs[0]])
    with pytest.raises(BadInput, match="no effect 'stiction'"):
        diagnose(runs, model, prior=["stiction"])
    with pytest.raises(BadInput, match="did you mean 'backlash'"):
        diagnose(runs, model, prior=["back_lash"])
    still = [dataclasses.replace(r, columns={n: np.zeros_like(v) for n, v in r.columns.items()}) for r in runs]
    with pytest.raises(BadInput, match="nothing moves"):
        diagnose(still, model)
    other = [
        run_of({"cmd.elbow": r.columns["cmd.joint"], "pos.elbow": r.columns["pos.joint"]}, r.t, ["elbow"]) for r in runs
    ]
    with pytest.raises(BadInput, match=r"joint"):
        diagnose(other, model)


def test_a_diagnosis_survives_its_json(tmp_path: Path) -> None:
    import json

    span = Span(0.02, 0.018, 0.022)
    found = Diagnosis(
        "m.xml", ("a", "b"), (), "action_delay", 0.9,
        (Found("action_delay", "all", {"delay_s": span}, 0.9, 0.8, 0.7, 0.9, True, {"delay_s": 0.02}),),
        ("action_delay",), (), None, {"before": 0.01, "after": 0.002, "floor": 0.001}, (),
    )  # fmt: skip
    path = tmp_path / "out.json"
    path.write_text(json.dumps(found.as_json()))
    again = read_diagnosis(path)
    assert again.as_json() == found.as_json()
    assert sizes(again.effects[0]) == "delay 20.0 ms (18.0 to 22.0)"
    path.write_text(path.read_text().replace('"effect": "action_delay"', '"effect": "gremlins"'))
    with pytest.raises(BadInput, match=r"out.json.*not known here: 'gremlins'"):
        read_diagnosis(path)
    path.write_text("{}")
    with pytest.raises(BadInput, match="no diagnosis"):
        read_diagnosis(path)


def test_what_a_signature_refutes_is_not_called_closest() -> None:
    lost, sticking = (
        Found(name, ("knee",), {}, 0.1, 0.3, 0.2, 0.4, True) for name in ("command_dropout", "stribeck_friction")
    )
    found = Diagnosis(
        "m.xml", ("a", "b"), (), UNEXPLAINED, 0.9, (lost, sticking), (), (), None,
        {"before": 0.01, "after": 0.008, "floor": 0.001}, (), refuted={"command_dropout": "it comes back at the same angles"},
    )  # fmt: skip
    assert "closest is stribeck_friction" in sentence(found)
    assert standing(found, lost) == "refuted: it comes back at the same angles"
    assert standing(found, sticking) == "closest, and not enough"


def test_a_gap_that_grows_is_not_said_to_close_by_less_than_nothing() -> None:
    """Near the floor a gap of 0.3 mrad more is minus three times what was above it."""
    worse, better = (
        Found(name, ("knee",), {}, 0.5, share, share - 0.1, share + 0.1, True)
        for name, share in (("stribeck_friction", -2.9), ("action_delay", 0.4))
    )
    found = Diagnosis(
        "m.xml", ("a", "b"), (), "stribeck_friction", 0.9, (worse, better), ("stribeck_friction",), (), None,
        {"before": 0.0011, "after": 0.0014, "floor": 0.001}, (), removal={"stribeck_friction": -0.2},
    )  # fmt: skip
    assert sentence(found).endswith("closes nothing of the gap on held-out runs.")
    assert standing(found, worse) == "in the improved model; as much closes without it"
    for share, words in ((0.52, "without it 52 % of the gap opens again"), (0.002, "as much closes without it")):
        kept = dataclasses.replace(found, removal={"stribeck_friction": share})
        assert standing(kept, worse) == f"in the improved model; {words}"
    assert standing(found, better) == "by itself it closes 40 %, but stribeck_friction closes nothing"
