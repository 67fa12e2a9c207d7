"""In how many ways a servo may tell its torque."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.effects.robot import Robot
from openant_tools.gap.features import differences
from openant_tools.gap.sensors import TorqueSensor, logged_by

T = np.arange(0.0, 2.0, 0.01)
TORQUE = np.stack([np.sin(5 * T), 0.5 * np.cos(3 * T)], axis=1).astype(np.float32)
PLAIN = {
    "filter_s": 0.0, "older_s": 0.0, "scale": np.ones(2), "offset": np.zeros(2), "standby": 0.0, "step": 0.0, "clip": math.inf,
    "unsigned": False,
}  # fmt: skip


def test_a_sensor_without_faults_tells_the_torque() -> None:
    np.testing.assert_allclose(TorqueSensor(**PLAIN)(TORQUE, T, 1.0), TORQUE, atol=1e-6)


def test_each_fault_is_what_it_is_called() -> None:
    def told(**fault: object) -> np.ndarray:
        return TorqueSensor(**{**PLAIN, **fault})(TORQUE, T, 0.5)

    assert np.abs(told(clip=1.0)).max() == 0.5
    assert (told(unsigned=True) >= 0).all()
    assert set(np.round(np.unique(told(step=0.5)) / 0.25, 6) % 1) == {0.0}
    np.testing.assert_allclose(told(older_s=0.05)[100], TORQUE[95], atol=1e-3)
    assert np.abs(told(filter_s=0.05)).max() < np.abs(TORQUE).max()
    assert (np.abs(told(standby=0.4))[1:] >= np.abs(TORQUE)[1:]).all()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_a_sensor_does_rows_without_a_sample_stay_so(seed: int) -> None:
    torque = TORQUE[None].copy()
    torque[:, :7] = np.nan
    out = logged_by([Robot(2)], {"torque": torque}, {}, np.random.default_rng(seed), T)["torque"]
    assert np.isnan(out[0, :7]).all()
    assert np.isfinite(out[0, 7:]).all()


def test_a_driver_without_a_sign_is_compared_by_size() -> None:
    model = {"torque": TORQUE[None]}
    apart = differences({"torque": np.abs(TORQUE[None]) * 3}, model, ["torque"])["torque"]
    np.testing.assert_allclose(apart, 0.0, atol=1e-5)
