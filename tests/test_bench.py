"""The bench work of the paper: knee torque, stiffness by kitchen scale, floor friction by tilted plate."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from openant_tools.cli import main
from openant_tools.robot.folder import create_robot
from openant_tools.robot.kit import kit
from openant_tools.robot.servo import servo_model
from openant_tools.sysid.bench.knee_torque import knee_load, knee_torque


def openant(*words: object) -> int:
    """Run a command line in this process; its exit code."""
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


# ---- knee torque ----


@pytest.mark.parametrize(("name", "said"), [("standard", 0.66), ("lite", 0.54)])
def test_the_papers_knee_torques(name: str, said: float) -> None:
    assert knee_torque(kit(name).total_mass_kg, 2, math.radians(45)) == pytest.approx(said, abs=0.005)


def test_the_torque_table_warns_of_the_lites_knees_and_not_of_the_standards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "torque.json"
    assert openant("sysid", "torque", "--kit", "standard") == 0
    assert "knees hold" in capsys.readouterr().out
    assert openant("sysid", "torque", "--kit", "lite", "--json", file) == 1
    out = capsys.readouterr().out
    assert "0.54 N·m against a nominal 0.28 N·m" in out
    content = json.loads(file.read_text())
    assert content["ok"] is False
    assert content["next_action"]
    # An XL430 at half its PWM: 1.4 N·m · 0.5.
    assert [row["limit_nm"] for row in content["data"]["rows"]] == pytest.approx([0.7] * 6)


def test_a_robots_own_mass_pose_and_limits_enter_and_the_finding_is_kept(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "ant", "standard", values={"bus.pwm_limit": 0.25})
    assert openant("sysid", "torque", "--robot", folder.path, "--mass", "3.9", "--legs", 2, "--angle", "45deg") == 1
    (file,) = folder.findings.iterdir()
    finding = json.loads(file.read_text())
    assert finding["data"]["rows"][0]["verdict"] == "gives way"
    assert finding["data"]["rows"][0]["limit_nm"] == pytest.approx(4.1 * 0.25)
    assert all(entry["unit"] and entry["source"] for entry in finding["evidence"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--angle", "45"], "write 45deg"),
        (["--legs", "5"], "1 to 4"),
        (["--mass", "-1"], "mass"),
        (["--servo", "XL430-W25"], "XL430-W250-T"),
        (["--supply", "24"], "does not run on 24 V"),
        (["--pwm-limit", "50"], "share of full duty"),
        (["--angle", "steep"], "is no angle"),
    ],
)
def test_what_cannot_be_asked_of_the_table_is_said(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert openant("sysid", "torque", "--kit", "standard", *words) == 2
    assert message in capsys.readouterr().err


def test_more_supply_gives_more_stall_torque_and_no_more_of_the_nominal() -> None:
    servo = servo_model("XM430-W350-T")
    low, high = (knee_load("knee_fl", servo, 1.2, 2, 0.8, supply_v=v, pwm_limit=0.5) for v in (11.1, 12.0))
    assert low.limit_nm == pytest.approx(high.limit_nm * 11.1 / 12)
    assert low.nominal_nm == high.nominal_nm
