"""Two fits, two robots or two dates side by side: what changed, and what only looks so."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from readable import unreadable

from openant_tools.cli import main
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.sysid.compare import Estimate, Snapshot, compare, holm

KINDS = {"stiffness": ("N·m/rad", 18.6), "damping": ("N·m·s/rad", 0.8), "coulomb_friction": ("N·m", 0.06)}


def openant(*words: object) -> int:
    """Run a command line in this process; its exit code."""
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


def fit(path: Path, values: Mapping[str, float] | None = None, relative: float = 0.02, **entries: object) -> Path:
    """A fit.json of a whole robot with intervals of ± 2 %, some of its values or entries of its parameters otherwise."""
    parameters: dict[str, object] = {}
    for kind, (unit, nominal) in KINDS.items():
        for joint in JOINT_NAMES:
            name = f"{kind}.{joint}"
            value = (values or {}).get(name, nominal)
            parameters[name] = {
                "value": value, "low": value * (1 - relative), "high": value * (1 + relative), "verdict": "identified",
                "unit": unit, "given": nominal, "joints": [joint], "information": 0.99,
            }  # fmt: skip
    content = {"schema": "openant.fit/1", "runs": [path.parent.name], "parameters": parameters, **entries}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def test_a_joint_that_aged_is_named_and_the_report_shows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = fit(tmp_path / "spring" / "fit.json")
    after = fit(tmp_path / "autumn" / "fit.json", {"coulomb_friction.knee_fl": 0.09, "damping.hip_rr": 0.81})
    assert (
        openant("sysid", "compare", before, after.parent, "--json", tmp_path / "c.json", "--report", tmp_path / "r")
        == 1
    )
    out = capsys.readouterr().out
    assert "Changed beyond chance at knee_fl: dry friction of knee_fl (+50 %); 24 parameters were compared." in out
    assert not unreadable(out)
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["joints_changed"] == ["knee_fl"]
    friction = content["parameters"]["coulomb_friction.knee_fl"]
    assert friction["low"] < 0.03 < friction["high"]
    assert content["parameters"]["damping.hip_rr"]["status"] == "same"
    page = (tmp_path / "r" / "report.html").read_text()
    assert "knee_fl ★" in page
    assert re.search(r"surest difference</span><b>\w[\w ]* of knee_fl</b>", page), "in words, which a line may break"


def test_a_robot_that_did_not_change_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = fit(tmp_path / "a" / "fit.json"), fit(tmp_path / "b" / "fit.json", {"stiffness.hip_fl": 18.7})
    assert openant("sysid", "compare", a, b) == 0
    assert "Nothing changed beyond chance, of 24 parameters compared." in capsys.readouterr().out


def test_chance_alone_calls_anything_changed_in_no_more_than_one_comparison_of_twenty() -> None:
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(600):
        a, b = (
            Snapshot(name, {f"stiffness.{k}": Estimate(x, x - 1.96, x + 1.96, "N·m/rad") for k, x in enumerate(draw)})
            for name, draw in (("a", 20 + rng.standard_normal(40)), ("b", 20 + rng.standard_normal(40)))
        )
        wrong += bool(compare(a, b).changed)
    # 5 % of 600 are 30, with a deviation of 5.3.
    assert 30 - 4 * 5.3 <= wrong <= 30 + 4 * 5.3


def test_holms_procedure_is_the_textbooks() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


def test_what_the_data_never_said_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = fit(tmp_path / "a" / "fit.json"), fit(tmp_path / "b" / "fit.json", {"stiffness.hip_fl": 30.0})
    content = json.loads(b.read_text())
    content["parameters"]["stiffness.hip_fl"]["verdict"] = "fell back"
    content["parameters"]["stiffness.hip_fr"]["unit"] = "N·cm/deg"
    content["parameters"]["stiffness.hip_rl"]["low"] = None
    b.write_text(json.dumps(content))
    assert openant("sysid", "compare", a, b) == 0
    out = capsys.readouterr().out
    assert "it fell back to the given model" in out
    assert "units differ" in out
    assert "has no interval" in out
    assert "of 21 parameters" in out


def test_lopsided_intervals_count_on_the_side_that_faces_the_other() -> None:
    a = Snapshot("a", {"delay.x": Estimate(1.0, 0.0, 1.1, "s")})
    up, down = (Snapshot("b", {"delay.x": Estimate(v, v - 0.1, v + 0.1, "s")}) for v in (1.5, 0.5))
    assert compare(a, up).changed
    assert not compare(a, down).changed


def test_a_tied_fit_is_compared_joint_by_joint_with_one_that_is_not() -> None:
    knees = ("knee_fl", "knee_fr")
    tied = Snapshot("tied", {"stiffness.XM430-W350-T": Estimate(18.0, 17.8, 18.2, "N·m/rad", joints=knees)})
    single = Snapshot(
        "single",
        {f"stiffness.{j}": Estimate(v, v - 0.2, v + 0.2, "") for j, v in zip(knees, (18.1, 15.0), strict=True)},
    )
    assert [change.name for change in compare(tied, single).changed] == ["stiffness.knee_fr"]


def test_shared_runs_and_near_misses_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = fit(tmp_path / "a" / "fit.json", runs=["monday"])
    b = fit(tmp_path / "b" / "fit.json", {"stiffness.hip_fl": 18.6 * 1.03}, runs=["monday"])
    assert openant("sysid", "compare", a, b) == 0
    out = capsys.readouterr().out
    assert "Both rest on monday" in out
    assert "stiffness of hip_fl would differ if looked at alone" in out


def test_a_robot_is_compared_with_itself_on_another_date(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = create_robot(tmp_path / "ant", "standard")
    for month, friction in ((3, 0.05), (9, 0.11)):
        values = {"identified.coulomb_friction.knee_fl": friction, "identified.coulomb_friction.knee_fr": 0.05}
        date = datetime.datetime(2026, month, 5, 12, tzinfo=datetime.UTC)
        provenance = {
            path: Provenance("fitted", "openant sysid fit", None, date, value - 0.005, value + 0.005)
            for path, value in values.items()
        }
        folder.update(values, provenance=provenance)
    assert openant("sysid", "compare", "2026-03-05", "2026-09-30", "--robot", folder.path) == 1
    assert "at knee_fl: dry friction of knee_fl (+120 %); 2 parameters" in capsys.readouterr().out
    assert [file.name.partition("-")[0] for file in folder.findings.glob("*.json")] == ["comparison"]
    assert openant("sysid", "compare", "2026-04-01", "2026-05-01", "--robot", folder.path) == 0
    assert "it was not measured anew in between" in capsys.readouterr().out
    assert openant("sysid", "compare", "2026-03-05", folder.path, "--robot", folder.path) == 1
    capsys.readouterr()
    assert openant("sysid", "compare", "2026-01-01", "2026-09-30", "--robot", folder.path) == 2
    assert "nothing was identified until 2026-01-01" in capsys.readouterr().err


def test_the_benchs_findings_are_compared_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, degrees in (("old", (31.0, 30.5, 31.5)), ("new", (24.0, 24.5, 23.8))):
        words = [word for angle in degrees for word in ("--static", f"{angle}deg")]
        assert openant("sysid", "tilt", *words, "--json", tmp_path / f"{name}.json") == 0
    assert openant("sysid", "compare", tmp_path / "old.json", tmp_path / "new.json") == 1
    assert "floor friction" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("nothing.json", None, "is no fit, no robot's folder and no date"),
        ("2026-03-01", None, "is a date of which robot?"),
        ("cut.json", '{"parameters": {', "this is not JSON"),
        ("empty.json", "{}", "holds no parameters"),
        ("list.json", "[1, 2]", "holds no parameters"),
        (
            "bad.json",
            '{"parameters": {"stiffness.hip_fl": {"value": 1}}}',
            "stiffness.hip_fl has no value, low and high",
        ),
        ("other.json", '{"parameters": {"x": {"value": 1, "low": 0, "high": 2}}}', "have no parameter in common"),
    ],
)
def test_what_cannot_be_compared_is_said(
    tmp_path: Path, name: str, text: str | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    good = fit(tmp_path / "good" / "fit.json")
    other: Path | str = name
    if text is not None:
        other = tmp_path / name
        other.write_text(text)
    assert openant("sysid", "compare", good, other) == 2
    assert message in capsys.readouterr().err
