"""Identification from Python: the notebook that shows it, and what a builder's script meets besides."""

from __future__ import annotations

import json
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import plants
import pytest
from places import ROOT

from openant_tools import sysid
from openant_tools.cli import main
from openant_tools.recording.tables import write_table
from openant_tools.sysid.rules import Verdict

NOTEBOOK, PAGE = ROOT / "examples" / "identify.ipynb", ROOT / "docs" / "python.md"


def code_cells() -> list[dict[str, Any]]:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """What stands in the notebook's memory after all of its cells, with the folder that it ran in."""
    place: dict[str, Any] = {"__name__": "__main__"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("notebook"))
        matplotlib.use("Agg")
        for cell in code_cells():
            exec(compile("".join(cell["source"]), f"{NOTEBOOK.name}, {cell['id']}", "exec"), place)
        yield place


# --- the notebook --------------------------------------------------------------------------------------------------------


def test_the_notebook_finds_the_servo_s_own_numbers(played: dict[str, Any]) -> None:
    found, true = played["found"], played["TRUE"]
    values = {value.name.partition(".")[0]: value for value in found.values}
    for kind, truth in true.items():
        value = values[kind]
        assert value.accepted, value
        assert value.low <= truth <= value.high, (value, truth)
        assert value.high - value.low < 0.6 * max(value.given, truth), "an interval that says something"
    # A fiftieth of what the model was off by, on a motion that it was not fitted to.
    assert found.after.full < 0.02 * found.before.full
    assert sysid.check([*played["runs"], played["kept_back"]], played["model"]) == ()


def test_the_notebook_s_picture_names_its_axes_and_the_lines(played: dict[str, Any]) -> None:
    above, below = played["figure"].axes
    assert (above.get_ylabel(), below.get_ylabel(), below.get_xlabel()) == (
        "position (rad)",
        "error (mrad)",
        "time (s)",
    )
    named = {text.get_text() for text in played["figure"].legends[0].get_texts()}
    assert named == {"measured", "command", "given model", "identified"}
    # Who sees no colours tells the two models by their dashes.
    assert len({line.get_linestyle() for line in below.lines}) == len(below.lines) == 2


def test_the_notebook_leaves_a_report_that_scripts_can_read(played: dict[str, Any]) -> None:
    fit = played["folder"] / "fit"
    assert {path.name for path in fit.iterdir()} == {"fit.json", "report.html", "calibrated.xml"}
    figures = json.loads((fit / "fit.json").read_text())
    assert figures["held_out"]["after"]["gap_full_rad"] == played["found"].after.full


def test_the_notebook_is_committed_without_what_it_printed() -> None:
    for cell in code_cells():
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


# --- judging -------------------------------------------------------------------------------------------------------------


def test_judging_a_model_a_fit_and_its_file_agrees_with_what_the_fit_says(played: dict[str, Any]) -> None:
    found, test = played["found"], played["kept_back"]
    given, fitted = sysid.judge(test, played["model"]), sysid.judge([test], found)
    written = sysid.judge(test, played["folder"] / "fit" / "calibrated.xml")
    for judged, gap in ((given, found.before), (fitted, found.after)):
        assert judged.gap.full == pytest.approx(gap.full, rel=1e-9)
        assert judged.gap.horizon == pytest.approx(gap.horizon, rel=1e-9)
        assert judged.by_joint["elbow"] == pytest.approx(gap.full, rel=1e-9)
    # A file's delay is a whole number of MuJoCo's steps or interpolated between them: the fit's to a tenth.
    assert written.gap.full == pytest.approx(found.after.full, rel=0.1)
    # The encoder's step, which no model can beat.
    assert fitted.floor == pytest.approx(plants.ENCODER_RAD / np.sqrt(12), rel=0.01)
    error = test.column("pos.elbow") - fitted.simulated[0][:, 0]
    assert float(np.sqrt(np.mean(error**2))) == pytest.approx(fitted.gap.full)
    assert "servo.xml, calibrated: full run" in str(fitted)


def test_a_fit_is_judged_by_the_joints_and_the_models_that_were_fitted(played: dict[str, Any], tmp_path: Path) -> None:
    found, test = played["found"], played["kept_back"]
    with pytest.raises(sysid.BadInput, match="the joints that were fitted: elbow"):
        sysid.judge(test, found, joints=["wrist"])
    # A run that names another model is one of the model that was fitted, where there was one.
    other = replace(test, facts=replace(test.facts, model=str(plants.write(tmp_path / "a.xml", plants.pendulum()))))
    assert sysid.judge(other, found).gap == sysid.judge(test, found).gap


def test_runs_of_several_gains_are_judged_each_by_its_own_model(played: dict[str, Any], tmp_path: Path) -> None:
    runs = []
    for gain, run in zip((8, 5, 8, 3), (*played["runs"], played["kept_back"], played["kept_back"]), strict=True):
        model = plants.write(tmp_path / f"kp{gain}.xml", played["MODEL"].replace('kp="8"', f'kp="{gain}"'))
        runs.append(replace(run, facts=replace(run.facts, model=str(model))))
    *fitted, test, unfitted = runs
    found = sysid.fit(fitted, hold_out=test, kinds=["stiffness", "coulomb_friction"])
    assert [path.name for path in found.models] == ["kp8.xml", "kp5.xml"]
    assert sysid.judge(test).gap.full == pytest.approx(found.before.full, rel=1e-9)
    assert sysid.judge(test, found).gap.full == pytest.approx(found.after.full, rel=1e-9)
    assert sysid.judge(runs[1], found).gap.full < sysid.judge(runs[1]).gap.full
    with pytest.raises(sysid.BadInput, match=r"its model is kp3\.xml, and fitted were kp8\.xml, kp5\.xml"):
        sysid.judge(unfitted, found)


# --- loading -------------------------------------------------------------------------------------------------------------


T = np.arange(200) / 100


def columns(**more: Any) -> dict[str, Any]:
    return {"t": T, "cmd.joint": np.sin(T), "pos.joint": 0.9 * np.sin(T)} | more


def test_columns_of_any_kind_become_a_run_with_what_is_known_besides(tmp_path: Path) -> None:
    run = sysid.load(
        columns(**{"torque.joint": T > 1, "pos.joint": [*np.sin(T[1:]), None], "err.joint": ["timeout"] * 200}),
        name="bench",
        facts={"supply_v": np.float32(12), "model": tmp_path / "arm.xml", "registers": {"joint": {"p": np.int64(9)}}},
    )
    assert (run.name, run.joints, run.facts.supply_v) == ("bench", ("joint",), 12.0)
    assert run.model_path == tmp_path / "arm.xml"
    assert np.isnan(run.column("pos.joint")[-1])
    assert run.column("torque.joint").tolist() == [0.0] * 101 + [1.0] * 99
    write_table(run, tmp_path / "bench.parquet")
    again = sysid.load(tmp_path / "bench", name="again", facts={"setup": "stand"})
    assert (again.name, again.facts.setup, again.facts.supply_v) == ("again", "stand", 12.0)
    assert np.array_equal(again.column("pos.joint"), run.column("pos.joint"), equal_nan=True)


@pytest.mark.parametrize(
    ("source", "facts", "said"),
    [
        (columns(**{"pos.joint": T[:9]}), None, "run, column pos.joint: it has 9 values, t has 200 → give one value a row"),
        (columns(**{"pos.joint": np.c_[T, T]}), None, "column pos.joint: the values are no column of numbers"),
        (columns(**{"pos.joint": 0.5}), None, "column pos.joint: the values are no column of numbers"),
        (columns(**{"pos.joint": 100 * T}), None, "cannot be → angles are in rad"),
        (columns(t=T[::-1]), None, "time runs backwards"),
        ({"cmd.joint": T}, None, "there is no column t"),
        ({"t": T, "cmd.joint": T}, None, "there is no pos column"),
        ({"time": T, "position": T}, None, "there is no column t"),
        ({0: T, 1: T}, None, "there is no column t"),
        ({}, None, "there is no column t"),
        (columns(), {"supply_v": "12 V"}, "run, its facts: `supply_v` is \"12 V\", not a number"),
        (columns(), {"joints": ["elbow"]}, "no such joint: joint"),
        ("nowhere", None, "nowhere: there is no such file"),
        ([T, T], None, "a run is a file or columns by their names, not list"),
    ],
)  # fmt: skip
def test_what_is_no_run_is_refused_in_a_line(source: Any, facts: Any, said: str) -> None:
    with pytest.raises(sysid.BadInput) as refused:
        sysid.load(source, facts=facts)
    assert said in str(refused.value)
    assert "→" in str(refused.value)
    assert "\n" not in str(refused.value)


# --- checking and fitting ------------------------------------------------------------------------------------------------


def test_check_says_what_a_fit_refuses_and_refuses_nothing(tmp_path: Path) -> None:
    model = plants.write(tmp_path / "arm.xml", plants.pendulum())
    slow = sysid.load(columns(t=1e3 * T), name="slow")
    found = sysid.check(slow, model)
    assert [one.verdict for one in found] == [Verdict.REFUSE]
    assert "slow: rows are 10 s apart" in str(found[0])
    with pytest.raises(sysid.BadInput, match="t looks like ms"):
        sysid.fit([slow], model)
    with pytest.raises(sysid.BadInput, match="t looks like ms"):
        sysid.judge(slow, model)
    # Without a model the rules that need none.
    assert [str(one) for one in sysid.check([slow])] == [str(one) for one in found]


def test_a_run_without_model_asks_for_one_and_a_single_row_is_left_out(played: dict[str, Any]) -> None:
    run = played["kept_back"]
    for attempt in (sysid.fit, sysid.judge):
        with pytest.raises(sysid.BadInput, match="no model is named"):
            attempt([run])
    row = replace(run, name="row", t=run.t[:1], columns={name: values[:1] for name, values in run.columns.items()})
    judged = sysid.judge([run, row], played["model"])
    assert [one.name for one in judged.runs] == ["motion 3"]
    assert judged.notes == ("row: it has one row and is left out → export all rows of the run",)
    with pytest.raises(sysid.BadInput, match="it has one row"):
        sysid.judge(row, played["model"])
    for unread in ("a.csv", ["a.csv"], [Path("a.csv")]):
        with pytest.raises(sysid.BadInput, match=r"this is no run: .*a\.csv.* → read it first: sysid\.load"):
            sysid.judge(unread, played["model"])  # type: ignore[arg-type]


def test_the_docs_page_and_the_command_find_the_same(
    played: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = played["model"].resolve()
    monkeypatch.chdir(tmp_path)
    Path("servo.xml").write_bytes(model.read_bytes())
    for name, run in zip("abc", (*played["runs"], played["kept_back"]), strict=True):
        write_table(run, f"{name}.csv")
    page: dict[str, Any] = {}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(blocks), PAGE.name, "exec"), page)
    capsys.readouterr()

    with pytest.raises(SystemExit) as left:
        main(["sysid", "fit", "a", "b", "--hold-out", "c", "--model", "servo.xml", "--out", "by-command"])
    assert left.value.code == 0
    assert capsys.readouterr().out.rstrip("\n") == sysid.summary(page["found"])
    by_command, by_page = (json.loads(Path(place, "fit.json").read_text()) for place in ("by-command", "fit"))
    assert by_command == by_page


# --- the package ---------------------------------------------------------------------------------------------------------


def test_the_package_costs_nothing_until_it_is_used() -> None:
    code = "import sys; from openant_tools import sysid; print(sysid.__all__ == dir(sysid), 'numpy' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ran.stdout.strip() == "True False", ran.stderr
    with pytest.raises(AttributeError, match="no attribute 'fits'"):
        sysid.fits  # type: ignore[attr-defined]  # noqa: B018


def test_no_module_of_the_package_takes_the_place_of_a_function() -> None:
    """Python sets a module that is imported as an attribute of its package, where it would hide a function of that name."""
    assert {module.name for module in pkgutil.iter_modules(sysid.__path__)}.isdisjoint(sysid.__all__)
