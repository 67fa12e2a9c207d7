"""A recording is cut to its telling windows, and what lies between is closed up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from openant_tools.gap.experiment import Experiment
from openant_tools.gap.protocol import rollouts_of
from openant_tools.recording.run import Facts, Run

PENDULUM = """
<mujoco model="pendulum"><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body pos="0 0 1"><inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>
    <joint name="hinge" axis="0 1 0" damping="0.03" armature="0.002"/></body></worldbody>
  <actuator><position name="hinge" joint="hinge" kp="1.5" forcerange="-0.5 0.5"/></actuator>
</mujoco>"""


def test_an_hour_is_no_more_to_simulate_than_its_twenty_telling_seconds(tmp_path: Path) -> None:
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM)
    t = 100.0 + np.arange(0.0, 120.0, 0.02)
    command = 0.5 * np.sin(0.7 * t) * (1 + 0.5 * np.sin(0.05 * t))
    columns = {"cmd.hinge": command, "pos.hinge": command, "cmd_t": t - 0.003}
    run = Run("long", Facts(joints=("hinge",), setup="stand"), t, columns)
    made = Experiment.of([run], model, ["hinge"])

    (one,) = made.protocol.runs
    assert made.selection.seconds <= 20.0 + 1e-6
    assert one.run.duration_s < 45.0, "what lies between windows is gone"
    assert (np.diff(one.run.t) > 0).all()
    np.testing.assert_allclose(one.run.column("cmd_t"), one.run.t - 0.003)
    for (start, stop), (begun, ended) in zip(made.selection.windows[0], one.windows or (), strict=True):
        # The same rows are in a window, whatever its times are called now.
        there = run.between(start, stop).column("pos.hinge")
        np.testing.assert_array_equal(
            one.run.between(begun - 1e-9, ended - 1e-9).column("pos.hinge")[: len(there) - 1], there[:-1]
        )
    simulated = rollouts_of([one])().pos[0, :, 0]
    assert np.isfinite(simulated).sum() * 0.02 <= 20.5

    assert len(made.folds) >= 4
    assert [played.run.name for played in made.parts.runs] == [str(part) for part in made.selection.folds]
