"""Rollouts keep the contract in their docstring: time, commands, torque, gaps, horizons, many models, all cores."""

from __future__ import annotations

import copy
import itertools
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import plain
import plants
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.errors import BadInput
from openant_tools.model import rollout
from openant_tools.model.gap import gap
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts, initial_velocities
from openant_tools.recording.run import Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.robot.mjcf import nominal_model_path

Array = plants.Array
H = 0.001


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Plant:
    return load_plant(plants.write(tmp_path_factory.mktemp("model") / "pendulum.xml", plants.pendulum()))


@pytest.fixture(scope="module")
def ant() -> Plant:
    return load_plant(nominal_model_path("standard"))


@pytest.fixture(scope="module")
def ant_on_floor() -> Plant:
    return load_plant(nominal_model_path("standard"), setup=Setup.FLOOR)


def swinging(plant: Plant, t: Array, **columns: Array) -> Run:
    """A run of one joint that the plant's own model would record; `columns` replaces or adds."""
    command = columns.pop("cmd.joint", plants.sweep(t, 1)[:, 0])
    made = plants.drive(plain.on_stand(plant.path), ["joint"], t, command[:, None])
    return plants.run_of(made | columns, t, ["joint"])


def walking(plant: Plant, seconds: float = 3.0, name: str = "walk", seed: int = 0) -> Run:
    """A run of the Ant on its stand."""
    t = plants.jittering(seconds, 100.0, seed=seed)
    command = np.array(home_angles()) + plants.sweep(t, 8, reach=0.3 + 0.1 * seed, high_hz=1.2)
    return plants.run_of(plants.drive(plain.on_stand(plant.path), JOINT_NAMES, t, command), t, JOINT_NAMES, name)


def with_columns(run: Run, **columns: Array) -> Run:
    return replace(run, columns={**run.columns, **{name.replace("__", "."): c for name, c in columns.items()}})


# --- time and commands -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", ["even", "jittering", "in bursts", "with a pause"])
def test_rows_may_come_at_any_times(spacing: str, pendulum: Plant) -> None:
    chance = np.random.default_rng(3)
    t = {
        "even": lambda: 4.0 + np.arange(300) / 100,
        "jittering": lambda: plants.jittering(3.0, 97.0, 0.004),
        "in bursts": lambda: 1e5 + np.cumsum(np.where(np.arange(400) % 4 == 3, 0.029, 0.0004)),
        "with a pause": lambda: np.concatenate([np.arange(100) / 90, 1.9 + np.sort(chance.uniform(0, 1.5, 120))]),
    }[spacing]()
    run = swinging(pendulum, t)
    simulated = Rollouts(pendulum, [run])().pos[0]
    # The truth was stepped from row to row; here a command counts for its share of a step, which is not quite the same
    # while torque is clipped.
    assert gap(run.signal("pos"), simulated) < 1e-3
    assert np.ptp(simulated) > 0.8


@pytest.mark.parametrize(("allowed", "threads"), [("3", 3), ("2,1", 2), ("all", 0), (None, 0)])
def test_as_many_threads_as_are_allowed_where_several_processes_share_a_computer(
    allowed: str | None, threads: int, pendulum: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if allowed is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", allowed)
    t = np.arange(20) / 50
    run = plants.run_of({"cmd.joint": np.zeros(20), "pos.joint": np.zeros(20)}, t, ["joint"])
    assert Rollouts(pendulum, [run]).nthread == threads
    assert Rollouts(pendulum, [run], nthread=1).nthread == 1, "whoever says how many gets them"


def test_a_command_acts_from_its_own_time_on(pendulum: Plant) -> None:
    """`cmd_t` five steps after `t` moves everything by five steps, which here is one row."""
    t = 2.0 + np.arange(600) * 5 * H
    run = swinging(pendulum, t)
    late = Rollouts(pendulum, [with_columns(run, cmd_t=t + 5 * H)])().pos[0]
    on_time = Rollouts(pendulum, [run])().pos[0]
    assert np.abs(late[1:] - on_time[:-1]).max() < 1e-5
    assert np.abs(late - on_time).max() > 0.02


def test_a_command_sent_between_two_steps_counts_for_its_share(pendulum: Plant) -> None:
    """So that positions follow a delay smoothly: half a step's delay is half of a step's (while torque is not clipped)."""
    t = 2.0 + np.arange(300) / 100
    run = swinging(pendulum, t, **{"cmd.joint": plants.sweep(t, 1, reach=0.1)[:, 0]})

    def delayed(by: float) -> Array:
        return Rollouts(pendulum, [with_columns(run, cmd_t=t + by)])().pos[0]

    none, half, whole = delayed(0), delayed(0.5 * H), delayed(H)
    assert np.abs(half - (none + whole) / 2).max() < 0.1 * np.abs(whole - none).max()


def test_a_delay_in_the_model_knows_what_was_commanded_before_a_segment(pendulum: Plant, tmp_path: Path) -> None:
    """As one of the commands does: else each segment would begin with a command that the servo has not yet heard."""
    t = 2.0 + np.arange(300) / 100
    run = swinging(pendulum, t)
    servo = f'<position {plants.SERVO} kp="8" forcerange="-1.5 1.5" delay="{20 * H}" nsample="22" interp="linear"/>'
    own = load_plant(plants.write(tmp_path / "late.xml", plants.pendulum(servo)))
    there = Rollouts(own, [run], 0.5)().pos
    assert np.abs(there - Rollouts(pendulum, [run], 0.5)(delays=np.array([[20 * H]])).pos).max() < 1e-6


def test_rows_faster_than_commands_repeat_the_command_in_force(pendulum: Plant) -> None:
    t = 2.0 + np.arange(600) / 200
    held = np.arange(600) // 10 * 10
    command = plants.sweep(t, 1)[held, 0]
    run = swinging(pendulum, t, **{"cmd.joint": command})
    repeated = Rollouts(pendulum, [with_columns(run, cmd_t=t[held])])().pos
    assert np.abs(repeated - Rollouts(pendulum, [run])().pos).max() < 1e-9


def test_a_missing_command_leaves_the_one_before_in_force(pendulum: Plant) -> None:
    t = 2.0 + np.arange(600) / 200
    held = np.arange(600) // 10 * 10
    command = plants.sweep(t, 1)[held, 0]
    run = swinging(pendulum, t, **{"cmd.joint": command})
    sparse = np.where(np.arange(600) == held, command, np.nan)
    assert np.array_equal(
        Rollouts(pendulum, [with_columns(run, cmd__joint=sparse)])().pos, Rollouts(pendulum, [run])().pos
    )


@settings(max_examples=200)
@given(
    gaps=st.lists(st.floats(0.0, 0.05), min_size=1, max_size=40),
    levels=st.lists(st.integers(-8, 8), min_size=41, max_size=41),
    start=st.floats(-0.05, 0.5),
    step=st.sampled_from([0.0005, 0.001, 0.002, 0.0041]),
    count=st.integers(1, 200),
    clock=st.sampled_from([0.0, 17.25, 86_400.0 * 30]),
)
def test_the_mean_of_a_staircase_over_steps_is_exact(
    gaps: list[float], levels: list[int], start: float, step: float, count: int, clock: float
) -> None:
    times = clock + np.concatenate([[0.0], np.cumsum(gaps)])
    values = np.array(levels[: len(times)], float)
    edges = clock + start + step * np.arange(count + 1)
    mean = rollout.Staircase.of(times, values[:, None]).mean(edges)[:, 0]

    def in_force(at: float) -> float:
        before = np.flatnonzero(times <= at)
        return float(values[before[-1]] if len(before) else values[0])

    for k in range(count):
        cuts = [edges[k], *times[(times > edges[k]) & (times < edges[k + 1])], edges[k + 1]]
        exact = sum(in_force(a) * (b - a) for a, b in itertools.pairwise(cuts)) / (edges[k + 1] - edges[k])
        # A clock of a month resolves half a nanosecond, which is 1e-6 of a step.
        assert mean[k] == pytest.approx(exact, abs=1e-9 if clock < 1e3 else 5e-5)


# --- torque ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [None, 0.5])
def test_a_leg_without_torque_falls_and_is_caught_again(horizon: float | None, pendulum: Plant) -> None:
    t = plants.jittering(3.0, 100.0)
    command = np.full((len(t), 1), 1.2)
    torque = np.ones_like(command)
    torque[100:170] = 0
    torque[220:] = 0
    columns = plants.drive(plain.on_stand(pendulum.path), ["joint"], t, command, torque=torque)
    run = plants.run_of(columns, t, ["joint"])
    simulated = Rollouts(pendulum, [run], horizon)().pos[0]
    assert gap(run.signal("pos"), simulated) < (5e-4 if horizon is None else 4e-3)
    assert simulated[165, 0] < 0.4 < 1.0 < simulated[210, 0]
    always_on = Rollouts(pendulum, [plants.run_of({k: columns[k] for k in ("cmd.joint", "pos.joint")}, t, ["joint"])])
    assert gap(run.signal("pos"), always_on().pos[0]) > 0.2


def test_each_joint_has_its_own_torque() -> None:
    """On an Ant whose joints move freely, so that knees fall where they are let go."""
    plant, model = load_plant(nominal_model_path("standard")), plain.on_stand(nominal_model_path("standard"))
    for one in (plant.model, model):
        one.dof_frictionloss[:] = 0
        one.dof_damping[:] /= 20
    t = plants.jittering(2.0, 100.0)
    command = np.tile(np.array(home_angles()), (len(t), 1))
    torque = np.ones_like(command)
    torque[40:90, 1] = 0
    torque[60:, 3] = 0
    torque[:70, 5] = 0
    columns = plants.drive(model, JOINT_NAMES, t, command, torque=torque)
    run = plants.run_of(columns, t, JOINT_NAMES)
    simulated = Rollouts(plant, [run])().pos[0]
    assert np.abs(simulated - run.signal("pos")).max() < 2e-3
    assert (np.ptp(run.signal("pos"), axis=0)[[1, 3, 5]] > 0.1).all()


# --- gaps, horizons, starts --------------------------------------------------------------------------------------------


def test_missing_samples_are_simulated_all_the_same(pendulum: Plant) -> None:
    t = plants.jittering(3.0, 100.0)
    run = swinging(pendulum, t)
    holes = run.signal("pos")[:, 0].copy()
    holes[np.random.default_rng(0).random(len(t)) < 0.3] = np.nan
    holes[0] = run.signal("pos")[0, 0]
    holed = with_columns(run, pos__joint=holes)
    whole, with_holes = Rollouts(pendulum, [run])().pos[0], Rollouts(pendulum, [holed])().pos[0]
    assert np.isfinite(with_holes).all()
    assert gap(whole, with_holes) < 1e-6
    assert gap(run.signal("pos"), Rollouts(pendulum, [holed], 0.5)().pos[0]) < 2e-3


def test_rows_before_the_first_whole_one_are_missing(ant: Plant) -> None:
    run = walking(ant)
    late = run.signal("pos", ["knee_fl"])[:, 0].copy()
    late[:25] = np.nan
    for horizon in (None, 0.5):
        out = Rollouts(ant, [with_columns(run, pos__knee_fl=late)], horizon)()
        assert np.isnan(out.pos[0, :25]).all()
        assert np.isnan(out.vel[0, :25]).all()
        assert np.isfinite(out.pos[0, 25:]).all()


def test_a_horizon_starts_anew_from_measurement(pendulum: Plant) -> None:
    """A model that droops is put right every half second, at rows that were measured, and nowhere else."""
    t = plants.jittering(3.0, 100.0, 0.001)
    run = swinging(pendulum, t)
    soft = load_plant(pendulum.path)
    soft.model.actuator_gainprm[0, 0] = 3.0
    soft.model.actuator_biasprm[0, 1] = -3.0
    measured = run.signal("pos")
    error = np.abs(Rollouts(soft, [run], 0.5)().pos[0] - measured)[:, 0]
    anew = 20 + np.flatnonzero(error[20:] < 1e-12)
    assert len(anew) == 5
    assert (np.diff(t[anew]) >= 0.5 - 1e-9).all()
    assert (np.diff(t[anew]) < 0.52).all()
    assert gap(measured, Rollouts(soft, [run])().pos[0]) > 1.05 * float(np.sqrt(np.mean(error**2))) > 0.05


def test_a_horizon_never_starts_where_a_joint_was_not_measured(ant: Plant) -> None:
    run = walking(ant)
    knee = run.signal("pos", ["knee_rl"])[:, 0].copy()
    knee[45:72] = np.nan
    error = np.abs(Rollouts(ant, [with_columns(run, pos__knee_rl=knee)], 0.5)().pos[0] - run.signal("pos"))
    anew = 20 + np.flatnonzero((error[20:] < 1e-12).all(axis=1))
    assert anew.tolist() == [72, 122, 172, 222, 272]


def test_velocities_at_a_start_are_the_slope_of_the_positions_around_it() -> None:
    t = plants.jittering(2.0, 190.0, 0.001)
    true = np.stack([np.sin(3 * t), 0.4 * t], axis=1)
    slope = np.stack([3 * np.cos(3 * t), np.full_like(t, 0.4)], axis=1)
    noisy = np.round((true + 2e-4 * np.random.default_rng(0).standard_normal(true.shape)) / 1.5e-3) * 1.5e-3
    noisy[70:74, 1] = np.nan
    for row in (0, 1, 70, 72, 200, len(t) - 1):
        within = 0.06 if 0 < row < len(t) - 1 else 0.15
        assert initial_velocities(t, noisy, row) == pytest.approx(slope[row], abs=within)
    slow = 0.1 * np.arange(5.0)
    assert initial_velocities(slow, slow[:, None] ** 2, 2)[0] == pytest.approx(0.4), "neighbours, however far"
    assert initial_velocities(slow, np.full((5, 1), np.nan), 2)[0] == 0


def test_a_start_in_motion_keeps_moving(pendulum: Plant) -> None:
    t = plants.jittering(3.0, 200.0)
    run = swinging(pendulum, t)
    fastest = int(np.argmax(np.abs(np.diff(run.signal("pos")[:, 0]))))
    cut = run.between(t[fastest], t[-1] + 1)
    simulated = Rollouts(pendulum, [cut])().pos[0]
    assert gap(cut.signal("pos"), simulated) < 2e-3


def test_joints_that_are_not_compared_rest_where_the_model_puts_them(tmp_path: Path) -> None:
    """Not at zero, which for a joint with `ref` would be a way to go."""
    text = plants.pendulum().replace(
        "</body>\n  </worldbody>",
        """\
  <body pos="0 0.2 0">
        <joint name="other" axis="0 1 0" ref="0.7" damping="0.1"/>
        <geom size="0.02" pos="0 0 -0.05" mass="0.1"/>
      </body>
    </body>
  </worldbody>""",
    )
    text = text.replace("</actuator>", '<position name="other" joint="other" kp="20"/></actuator>')
    path = plants.write(tmp_path / "two.xml", text)
    t = plants.jittering(2.0, 100.0)
    alone = load_plant(path, ["joint"])
    columns = {"cmd.joint": plants.sweep(t, 1)[:, 0], "pos.joint": np.zeros(len(t))}
    both = columns | {"cmd.other": np.full(len(t), 0.7), "pos.other": np.full(len(t), 0.7)}
    one = Rollouts(alone, [plants.run_of(columns, t, ["joint"])])().pos[0][:, 0]
    two = Rollouts(load_plant(path), [plants.run_of(both, t, ["joint", "other"])])().pos[0][:, 0]
    assert np.abs(one - two).max() < 1e-9


# --- many runs, many models, all cores ---------------------------------------------------------------------------------


def variants(plant: Plant) -> list[Any]:
    out = []
    for k in range(5):
        model = load_plant(plant.path, plant.joints, plant.setup).model
        model.dof_damping[plant.dof] *= 1 + 0.1 * k
        model.actuator_forcerange[plant.actuator] *= 1 - 0.05 * k
        out.append(model)
    return out


@pytest.mark.parametrize("horizon", [None, 0.5])
def test_results_depend_neither_on_threads_nor_on_company(horizon: float | None, ant: Plant) -> None:
    runs = [walking(ant, 2.0, seed=1), walking(ant, 3.0), walking(ant, 1.2, seed=2)]
    torque = np.ones(len(runs[1].t))
    torque[80:130] = 0
    runs[1] = with_columns(runs[1], torque__hip_fr=torque)
    models = variants(ant)
    together = Rollouts(ant, runs, horizon, nthread=2)(models)
    again = Rollouts(ant, runs, horizon, nthread=1)(models)
    assert np.array_equal(together.pos, again.pos, equal_nan=True)
    assert np.array_equal(together.vel, again.vel, equal_nan=True)
    for k in (0, 3):
        alone = Rollouts(ant, runs, horizon)([models[k]])
        assert np.array_equal(together.pos[k], alone.pos[0], equal_nan=True)
    for run, rows in zip(runs, together.rows, strict=True):
        by_itself = Rollouts(ant, [run], horizon)(models)
        assert np.array_equal(together.pos[:, rows], by_itself.pos, equal_nan=True)
    assert not np.array_equal(together.pos[0], together.pos[4])


def test_a_call_leaves_nothing_behind_for_the_next(pendulum: Plant) -> None:
    t = plants.jittering(2.0, 100.0)
    torque = np.ones((len(t), 1))
    torque[50:90] = 0
    columns = plants.drive(plain.on_stand(pendulum.path), ["joint"], t, plants.sweep(t, 1), torque=torque)
    prepared = Rollouts(pendulum, [plants.run_of(columns, t, ["joint"])], 0.5)
    first = prepared().pos
    prepared(variants(pendulum))
    prepared([variants(pendulum)[4]])
    assert np.array_equal(prepared().pos, first)


@pytest.mark.parametrize("chunk", [1, 3000, 50_000])
def test_results_do_not_depend_on_the_size_of_chunks(chunk: int, ant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [walking(ant, 2.0), walking(ant, 1.3, seed=1)]
    for horizon in (None, 0.5):
        whole = Rollouts(ant, runs, horizon)(variants(ant))
        with monkeypatch.context() as patch:
            patch.setattr(rollout, "CHUNK_BYTES", chunk)
            chunked = Rollouts(ant, runs, horizon)(variants(ant))
        assert np.array_equal(whole.pos, chunked.pos)
        assert np.array_equal(whole.vel, chunked.vel)


def test_memory_does_not_grow_with_the_steps(ant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows a tenth of a second apart: what is kept of a hundred steps is one of them."""
    t = np.arange(0, 10.0, 0.1)
    command = np.array(home_angles()) + plants.sweep(t, 8, reach=0.2)
    columns = {f"{signal}.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES) for signal in ("cmd", "pos")}
    prepared = Rollouts(ant, [plants.run_of(columns, t, JOINT_NAMES)])
    models = [ant.model] * 16
    prepared(models)
    chunk = 2**19
    monkeypatch.setattr(rollout, "CHUNK_BYTES", chunk)
    tracemalloc.start()
    prepared(models)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    everything = 8 * prepared.steps * len(models) * (ant.model.nq + ant.model.nv)
    assert everything > 30 * chunk
    assert peak < 6 * chunk


def test_steps_are_counted_once_a_variant(pendulum: Plant) -> None:
    t = np.arange(0, 2.0, 0.01)
    run = swinging(pendulum, t)
    assert Rollouts(pendulum, [run, run]).steps == pytest.approx(2 * 1990, abs=4)
    assert Rollouts(pendulum, [run], 0.5).steps == pytest.approx(1990, abs=60)


# --- the floor ---------------------------------------------------------------------------------------------------------


def test_finer_steps_are_those_of_a_model_with_a_smaller_step(ant: Plant) -> None:
    run = walking(ant, 1.5)
    off = np.ones(len(run.t))
    off[40:60] = 0.0
    run = with_columns(run, torque__knee_fl=off)
    small = replace(ant, model=copy.copy(ant.model))
    small.model.opt.timestep = ant.timestep / 2
    coarse = Rollouts(ant, [run], 0.5)
    found, wanted = coarse.finer(2)().pos[0], Rollouts(small, [run], 0.5)().pos[0]
    there = np.isfinite(coarse().pos[0]).all(axis=1)
    assert np.array_equal(there, np.isfinite(found).all(axis=1))
    assert found[there] == pytest.approx(wanted[there], abs=1e-9)
    assert coarse.finer(2) is coarse.finer(2)


def test_finer_steps_of_rows_that_scatter_are_taken_as_well(ant: Plant) -> None:
    """Rows lie between steps: of segments that take as many, one may take fewer smaller ones than the next."""
    run = walking(ant, 3.0)
    jittered = np.sort(run.t + np.random.default_rng(0).uniform(-0.002, 0.002, len(run.t)))
    fine = Rollouts(ant, [replace(run, t=jittered)], 0.2).finer(2)
    lengths = [len(segment.control) for segment in fine.segments]
    assert lengths == sorted(lengths, reverse=True)
    assert np.isfinite(fine().pos[0]).all()


def on_the_floor(plant: Plant, seconds: float = 2.0, heading: float = 0.0, rate: float = 4.0) -> Run:
    """An Ant that shifts its weight on the floor, with its base measured."""
    model = plain.on_floor(plant.path)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[3:7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
    mujoco.mj_step(model, data, 1500)
    t = 3.0 + np.arange(round(100 * seconds)) / 100
    home = np.array(home_angles())
    sway = np.clip((t - t[0] - 0.2) / 0.4, 0, 1) * np.sin(rate * (t - t[0] - 0.2))
    command = home + sway[:, None] * np.array([0.15, 0.1, -0.15, 0.1, 0.15, -0.1, -0.15, -0.1])
    place = ("x", "y", "z", "qw", "qx", "qy", "qz")
    columns = {f"base.{name}": np.empty(len(t)) for name in place}
    columns |= {f"{signal}.{joint}": np.empty(len(t)) for joint in JOINT_NAMES for signal in ("cmd", "pos")}
    for k in range(len(t)):
        for name, value in zip(place, data.qpos[:7], strict=True):
            columns[f"base.{name}"][k] = value
        for j, joint in enumerate(JOINT_NAMES):
            columns[f"cmd.{joint}"][k] = command[k, j]
            columns[f"pos.{joint}"][k] = data.joint(joint).qpos[0]
        data.ctrl[:] = command[k]
        mujoco.mj_step(model, data, 10)
    return plants.run_of(columns, t, JOINT_NAMES, "floor", setup="floor", heading_rad=heading)


def without(run: Run, *columns: str) -> Run:
    return replace(run, columns={name: c for name, c in run.columns.items() if name not in columns})


PLACE = ("base.x", "base.y", "base.z", "base.qw", "base.qx", "base.qy", "base.qz")


def test_a_floor_run_starts_from_its_measured_base(ant_on_floor: Plant) -> None:
    run = on_the_floor(ant_on_floor)
    measured = run.signal("pos")
    assert gap(measured, Rollouts(ant_on_floor, [run])().pos[0]) < 2e-4
    assert gap(measured, Rollouts(ant_on_floor, [run], 0.5)().pos[0]) < 2e-3
    lifted = with_columns(run, base__z=run.column("base.z") + 0.05)
    assert gap(measured, Rollouts(ant_on_floor, [lifted])().pos[0]) > 1e-3


@pytest.mark.parametrize("known", ["nothing", "the place", "the place and the heading"])
def test_a_floor_run_without_its_attitude_starts_settled_on_its_feet(known: str, ant_on_floor: Plant) -> None:
    run = on_the_floor(ant_on_floor)
    yaw = np.full(len(run.t), 0.0)
    settled = {
        "nothing": without(run, *PLACE),
        "the place": without(run, *PLACE[3:]),
        "the place and the heading": with_columns(without(run, *PLACE[3:]), base__yaw=yaw),
    }[known]
    measured = run.signal("pos")
    simulated = Rollouts(ant_on_floor, [settled])().pos[0]
    assert gap(measured[:20], simulated[:20]) < 1e-3, "it stands before it sways, and does not drop first"
    assert gap(measured, simulated) < 5e-3


@pytest.mark.parametrize("rate", [4.0, 8.0])
def test_a_horizon_on_the_floor_starts_with_the_base_in_motion(
    rate: float, ant_on_floor: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = without(on_the_floor(ant_on_floor, rate=rate), *PLACE)
    whole = Rollouts(ant_on_floor, [run])().pos[0]
    again = with_columns(run, **{f"pos__{joint}": whole[:, j] for j, joint in enumerate(ant_on_floor.joints)})
    led = gap(whole, Rollouts(ant_on_floor, [again], 0.5)().pos[0])
    # As if it had fallen over each time: then it starts settled, at rest.
    monkeypatch.setattr("openant_tools.model.rollout.FALLEN", 1.1)
    assert led < 0.5 * gap(whole, Rollouts(ant_on_floor, [again], 0.5)().pos[0])


def test_a_settled_robot_faces_where_the_run_says(ant_on_floor: Plant) -> None:
    """On a floor that slopes, facing another way is another motion."""
    slope = load_plant(ant_on_floor.path, setup=Setup.FLOOR)
    slope.model.opt.gravity[:] = 9.81 * np.array([np.sin(0.12), 0, -np.cos(0.12)])
    straight, left = on_the_floor(ant_on_floor), on_the_floor(ant_on_floor, heading=np.pi / 2)
    assert gap(straight.signal("pos"), left.signal("pos")) < 1e-3
    ahead = Rollouts(slope, [without(straight, *PLACE)])().pos[0]
    aside = Rollouts(slope, [without(left, *PLACE)])().pos[0]
    assert gap(ahead, aside) > 3e-3
    by_column = with_columns(without(straight, *PLACE), base__yaw=np.full(len(straight.t), np.pi / 2))
    assert gap(Rollouts(slope, [by_column])().pos[0], aside) < 1e-3


# --- bad input ---------------------------------------------------------------------------------------------------------


def test_a_joint_that_was_never_commanded_is_refused(ant: Plant) -> None:
    run = walking(ant, 1.2, name="shy")
    with pytest.raises(BadInput, match="shy: some joint was never commanded → drop it with --joint"):
        Rollouts(ant, [with_columns(run, cmd__hip_rr=np.full(len(run.t), np.nan))])
    with pytest.raises(BadInput, match="never commanded"):
        Rollouts(ant, [without(run, "cmd.knee_fl")])


@pytest.mark.parametrize(
    "spoil", [lambda pos: pos * np.nan, lambda pos: np.where(np.arange(len(pos)) == 5, pos, np.nan)]
)
def test_a_run_that_measured_nothing_whole_is_refused(spoil: Callable[[Array], Array], ant: Plant) -> None:
    run = walking(ant, 1.2, name="blind")
    blind = with_columns(run, pos__knee_fr=spoil(run.columns["pos.knee_fr"]))
    with pytest.raises(
        BadInput, match=r"blind: no two rows have a position of every joint → check the pos\.\* columns"
    ):
        Rollouts(ant, [blind])


@pytest.mark.parametrize("horizon", [None, 0.5])
def test_positions_are_what_a_late_encoder_says(tmp_path: Path, horizon: float | None) -> None:
    """As MuJoCo's own sensor does: commands are not late for that, and a start amid the run is where the joint was then."""
    late = '<sensor><jointpos name="pos.joint" joint="joint" delay="0.03" nsample="40" interp="linear"/></sensor>'
    model = plants.write(tmp_path / "late.xml", plants.pendulum(more=late))
    on_time = plants.write(tmp_path / "on_time.xml", plants.pendulum())
    t = 0.01 * np.arange(300)
    command = plants.sweep(t, 1)[:, 0]
    robot = plain.on_stand(model)
    data = mujoco.MjData(robot)
    data.joint("joint").qpos[0] = command[0]
    said, were = np.empty(len(t)), np.empty(len(t))
    for k, asked in enumerate(command):
        mujoco.mj_step1(robot, data)  # which reads the sensors
        said[k], were[k] = data.sensor("pos.joint").data[0], data.joint("joint").qpos[0]
        data.ctrl[0] = asked
        mujoco.mj_step2(robot, data)
        mujoco.mj_step(robot, data, 9)
    told = plants.run_of({"cmd.joint": command, "pos.joint": said}, t, ["joint"])
    true = plants.run_of({"cmd.joint": command, "pos.joint": were}, t, ["joint"])
    begun = t > 0.05  # buffers were filled with where it began

    def off(path: Path, run: Run) -> float:
        simulated = Rollouts(load_plant(path), [run], horizon)().pos[0, :, 0]
        return float(np.sqrt(np.mean(np.square(simulated - run.column("pos.joint"))[begun])))

    usual = off(on_time, true)
    assert off(model, told) < usual + 1e-3 < 0.02 * off(on_time, told)


def test_encoders_that_are_late_by_different_times_are_refused(tmp_path: Path) -> None:
    text = nominal_model_path("standard").read_text()
    sensor = '<jointpos name="pos.hip_rr"'
    assert sensor in text
    model = plants.write(tmp_path / "one.xml", text.replace(sensor, f'{sensor} delay="0.03" nsample="40"'))
    run = walking(load_plant(nominal_model_path("standard")), 0.5)
    with pytest.raises(BadInput, match="not all of them the same"):
        Rollouts(load_plant(model), [run])
