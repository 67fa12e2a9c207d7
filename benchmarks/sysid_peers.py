"""Beside mujoco.sysid, in one run: same truth, same data, same start, same judge.

    pip install 'mujoco[sysid]'
    python benchmarks/sysid_peers.py [--only servo|far|ant|real]

Prints Markdown. (a) One servo that lifts a pendulum, 10 s, five parameters: within a build's tolerance of the given model, and
two to three times off it. (b) An Ant on its stand, 3 runs of 10 s, 32 parameters. Both robots are simulated as the fits
simulate them, so that what is wrong afterwards is the estimator's; encoders have 4096 steps and some noise. (c) Real
recordings of an XL330 (../shared/realdata): each motion of each gain held out, the other two fitted.

mujoco.sysid gets what a user who knows it would give: `x_scale="jac"`, bounds of a tenth to ten times the given value, commands
held and resampled to the model's step, contacts off where nothing touches. It has no torque that is switched off: of such runs
it gets the part with torque. Its time is that of `optimize`; beside it stand our fit (`Problem.solve`, intervals included)
and, in brackets, the whole of `identify`, which also checks the runs and judges every value on the held-out ones. Errors are root mean squares of held-out position over the full run, by the
same rollout for both.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid
from numpy.typing import NDArray

from openant_tools.model.gap import gap
from openant_tools.model.plant import Plant, load_plant
from openant_tools.model.rollout import Rollouts, initial_velocities
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.dataset import Dataset, sensor_floor
from openant_tools.sysid.identify import calibrated, identify
from openant_tools.sysid.kinds import KINDS
from openant_tools.sysid.parameter import choose
from openant_tools.sysid.problem import Problem
from openant_tools.sysid.protocols import CommandSpace, protocol

Array = NDArray[np.float64]

ENCODER_RAD = 2 * math.pi / 4096
NOISE_RAD = 3e-4
ROWS_HZ = 100.0
#: deviations of a robot within the tolerance of its build (effects.md), as factors
SCATTER = {"stiffness": 0.075, "velocity_gain": 0.125, "damping": 0.125, "armature": 0.15, "coulomb_friction": 0.2}

PENDULUM = """
<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="joint" axis="0 1 0" damping="0.12" armature="0.006" frictionloss="0.03"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.02"/>
      <geom type="sphere" pos="0 0 -0.1" size="0.04" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="joint" joint="joint" kp="8" kv="0.1" forcerange="-1.2 1.2"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Case:
    """What both get.

    Attributes:
        model: the MJCF they start from.
        fitted, held_out: the runs.
        kinds: what is identified, in every joint.
        truth: `kind.joint` → value, where it is known.
    """

    title: str
    model: Path
    fitted: Sequence[Run]
    held_out: Sequence[Run]
    kinds: Sequence[str]
    truth: Mapping[str, float]

    @property
    def plant(self) -> Plant:
        return load_plant(self.model, list(self.fitted[0].joints))


@dataclass(frozen=True)
class Outcome:
    """Values by name, error on the held-out runs (rad), time (s), and time with all that is done besides (s)."""

    values: Mapping[str, float]
    held_out: float
    seconds: float
    whole: float


# --- the two -----------------------------------------------------------------------------------------------------------


def ours(case: Case) -> Outcome:
    begun = time.monotonic()
    plant = case.plant
    Problem(
        [Dataset.prepare(plant, case.fitted)], choose(plant, case.kinds), sensor_floor(case.fitted, plant.joints)
    ).solve()
    seconds = time.monotonic() - begun
    begun = time.monotonic()
    result = identify(case.fitted, case.model, case.held_out, kinds=case.kinds)
    whole = time.monotonic() - begun
    values = {value.name: value.value for value in result.values}
    return Outcome(values, judged(case, calibrated(result, case.plant.setup)), seconds, whole)


def theirs(case: Case) -> Outcome:
    begun = time.monotonic()
    plant = case.plant
    parameters = sysid.ParameterDict()
    for kind in case.kinds:
        for j, joint in enumerate(plant.joints):
            given = KINDS[kind].read(plant.model, plant, j)
            low, high = (given / 10, given * 10) if given else (0.0, 0.2)
            parameters.add(sysid.Parameter(f"{kind}.{joint}", given, low, high, modifier=MODIFIERS[kind](joint)))
    parameters.move_off_bounds()
    spec = as_spec(case)
    model = spec.compile()
    runs = [measured(run, model, plant.joints) for run in case.fitted]
    sequences = sysid.ModelSequences(
        "robot", spec, [run.name for run in case.fitted], *([run[k] for run in runs] for k in range(3))
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(parameters, residual, verbose=False, x_scale="jac")
    seconds = time.monotonic() - begun
    values = {name: float(parameter.value[0]) for name, parameter in found.items()}
    identified = copy.copy(plant.model)
    for name, value in values.items():
        kind, _, joint = name.partition(".")
        KINDS[kind].write(identified, plant, plant.joints.index(joint), value)
    mujoco.mj_setConst(identified, mujoco.MjData(identified))
    return Outcome(values, judged(case, identified), seconds, seconds)


def _gain(joint: str, k: int) -> Callable[[Any, Any], None]:
    def modify(spec: Any, parameter: Any) -> None:
        actuator, value = spec.actuator(joint), float(parameter.value[0])
        actuator.biasprm[k] = -value
        if k == 1:
            actuator.gainprm[0] = value

    return modify


def _damping(joint: str) -> Callable[[Any, Any], None]:
    def modify(spec: Any, parameter: Any) -> None:
        spec.joint(joint).damping[0] = float(parameter.value[0])

    return modify


def _of_joint(attribute: str) -> Callable[[str], Callable[[Any, Any], None]]:
    def of(joint: str) -> Callable[[Any, Any], None]:
        return lambda spec, parameter: setattr(spec.joint(joint), attribute, float(parameter.value[0]))

    return of


MODIFIERS: Mapping[str, Callable[[str], Callable[[Any, Any], None]]] = {
    "stiffness": lambda joint: _gain(joint, 1),
    "velocity_gain": lambda joint: _gain(joint, 2),
    "damping": _damping,
    "armature": _of_joint("armature"),
    "coulomb_friction": _of_joint("frictionloss"),
}


def as_spec(case: Case) -> Any:
    """The model on its stand, with the encoders as its only sensors."""
    spec = mujoco.MjSpec.from_file(str(case.model))
    for key in list(spec.keys):
        spec.delete(key)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        spec.delete(joint)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for joint in case.plant.joints:
        spec.add_sensor(
            name=f"pos.{joint}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec


def measured(run: Run, model: Any, joints: Sequence[str]) -> tuple[Array, Any, Any]:
    """A run as mujoco.sysid takes it: initial state, commands at every step, positions at their own times."""
    on = (run.signal("torque", joints, default=1.0) != 0).all(axis=1)
    stop = len(on) if on.all() else int(np.argmin(on))
    t = run.t[:stop] - run.t[0]
    pos, cmd = run.signal("pos", joints)[:stop], run.signal("cmd", joints)[:stop]
    steps = np.arange(0.0, t[-1] + model.opt.timestep, model.opt.timestep)
    row = np.searchsorted(run.command_times[:stop] - run.t[0], steps + 1e-9, side="right") - 1
    # It counts the steps of a resampled control by rounding up: a hair past the last one it would stretch them all.
    steps[-1] -= 1e-9
    control = np.zeros((len(steps), model.nu))
    control[:, [model.actuator(joint).id for joint in joints]] = cmd[np.maximum(row, 0)]
    qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
    qpos[[model.joint(joint).qposadr[0] for joint in joints]] = pos[0]
    qvel[[model.joint(joint).dofadr[0] for joint in joints]] = initial_velocities(run.t[:stop], pos, 0)
    state = sysid.create_initial_state(model, qpos, qvel, np.zeros(model.na))
    # A step's sensors are of its beginning, and it stamps them with its end: data must be late by a step to meet them.
    return state, sysid.TimeSeries(steps, control), sysid.TimeSeries.from_names(t + model.opt.timestep, pos, model)


def judged(case: Case, model: mujoco.MjModel) -> float:
    """The full-run error of a model on the held-out runs, torque off where it was."""
    simulated = Rollouts(case.plant, case.held_out)([model]).pos[0]
    return gap(np.concatenate([run.signal("pos", case.plant.joints) for run in case.held_out]), simulated)


# --- the cases ---------------------------------------------------------------------------------------------------------


def robot(plant: Plant, factors: Mapping[str, Array]) -> tuple[mujoco.MjModel, dict[str, float]]:
    """The plant's model with each kind multiplied, joint by joint; and what its values are."""
    model, truth = copy.copy(plant.model), {}
    for kind, scale in factors.items():
        for j, joint in enumerate(plant.joints):
            truth[f"{kind}.{joint}"] = KINDS[kind].read(plant.model, plant, j) * float(scale[j])
            KINDS[kind].write(model, plant, j, truth[f"{kind}.{joint}"])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model, truth


def record(plant: Plant, model: mujoco.MjModel, command: Array, name: str, seed: int) -> Run:
    """What the robot logs when it is commanded so, from rest."""
    data = mujoco.MjData(model)
    data.qpos[plant.qpos] = data.ctrl[plant.ctrl] = command[0]
    steps = round(1 / ROWS_HZ / plant.timestep)
    position = np.empty(command.shape)
    for k, row in enumerate(command):
        position[k] = data.qpos[plant.qpos]
        data.ctrl[plant.ctrl] = row
        mujoco.mj_step(model, data, steps)
    position += NOISE_RAD * np.random.default_rng(seed).standard_normal(position.shape)
    position = np.round(position / ENCODER_RAD) * ENCODER_RAD
    columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(plant.joints)}
    columns |= {f"pos.{joint}": position[:, j] for j, joint in enumerate(plant.joints)}
    return Run(name, Facts(plant.joints, setup="stand"), np.arange(len(command)) / ROWS_HZ, columns)


def servo(folder: Path, far: bool, robot_seed: int) -> Case:
    """One servo whose velocity gain and damping can be told apart: its steps saturate torque."""
    path = folder / "pendulum.xml"
    path.write_text(PENDULUM.strip())
    plant = load_plant(path)
    near = {"stiffness": 0.9, "velocity_gain": 1.2, "damping": 0.8, "armature": 1.25, "coulomb_friction": 1.5}
    off = {"stiffness": 0.5, "velocity_gain": 2.0, "damping": 0.5, "armature": 2.0, "coulomb_friction": 3.0}
    chance = np.random.default_rng(robot_seed)
    # Each robot is as far off as the next, to one side or the other.
    sides = {kind: factor ** chance.choice([-1, 1]) for kind, factor in (off if far else near).items()}
    model, truth = robot(plant, {kind: np.array([factor]) for kind, factor in sides.items()})
    runs = []
    for seed in (2 * robot_seed, 2 * robot_seed + 1):
        t = np.arange(round(10 * ROWS_HZ)) / ROWS_HZ
        chance = np.random.default_rng(seed)
        chirp = 0.6 * np.sin(2 * np.pi * (0.3 * t + 0.2 * t**2)) * np.clip(t / 0.3, 0, 1)
        steps = np.repeat(chance.uniform(-1.0, 1.0, 20), 50)
        runs.append(record(plant, model, np.where(t < 5, chirp, steps)[:, None], f"servo {seed}", seed))
    title = "one servo, 10 s, 5 parameters, start 2 to 3 times off" if far else "one servo, 10 s, 5 parameters"
    return Case(title, path, runs[:1], runs[1:], list(near), truth)


def ant(folder: Path, robot_seed: int) -> Case:
    path = folder / "ant.xml"
    path.write_text(nominal_model_path("standard").read_text().replace('timestep="0.001"', 'timestep="0.002"'))
    plant = load_plant(path, JOINT_NAMES)
    kinds = ["stiffness", "damping", "armature", "coulomb_friction"]
    chance = np.random.default_rng(robot_seed)
    model, truth = robot(plant, {kind: np.exp(SCATTER[kind] * chance.standard_normal(8)) for kind in kinds})
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    runs = []
    for seed in range(4 * robot_seed, 4 * robot_seed + 4):
        command = protocol("stand", 10.0).commands(CommandSpace.around_home(), ROWS_HZ, seed)
        runs.append(record(plant, model, command[: round(10 * ROWS_HZ)], f"stand {seed}", seed))
    return Case("the Ant on its stand, 3 runs of 10 s, 32 parameters", path, runs[:3], runs[3:], kinds, truth)


def real(folder: Path) -> list[Case]:
    gains: dict[Path, list[Run]] = {}
    for path in sorted(folder.glob("*.parquet")):
        run = read_run(path)
        assert run.model_path is not None
        gains.setdefault(run.model_path, []).append(run)
    kinds = ["stiffness", "damping", "armature", "coulomb_friction"]
    return [
        Case(held_out.name, model, [run for run in runs if run is not held_out], [held_out], kinds, {})
        for model, runs in gains.items()
        for held_out in runs
    ]


# --- what is printed ---------------------------------------------------------------------------------------------------


def known(cases: Sequence[Case]) -> None:
    robots = "one robot" if len(cases) == 1 else f"{len(cases)} robots"
    print(f"\n### {cases[0].title}: {robots}, root mean squares, median times\n")
    kinds = cases[0].kinds
    names = [f"{kind.replace('_', ' ')}, %" for kind in kinds]
    print(f"| | {' | '.join(names)} | all, % | held-out error, mrad | time, s |")
    print(f"|---|{'---|' * (len(names) + 3)}")
    given = rms([judged(case, case.plant.model) for case in cases])
    print(f"| given model |{' |' * (len(names) + 1)} {1e3 * given:.2f} | |", flush=True)
    # In turns, so that what else the machine does falls on both.
    both = [(ours(case), theirs(case)) for case in cases]
    for name, outcomes in zip(("Open Ant Tools", "mujoco.sysid"), zip(*both, strict=True), strict=True):
        errors = {
            kind: [
                100 * (outcome.values[key] / true - 1)
                for case, outcome in zip(cases, outcomes, strict=True)
                for key, true in case.truth.items()
                if key.startswith(f"{kind}.")
            ]
            for kind in kinds
        }
        seconds, whole = (
            float(np.median([o.seconds for o in outcomes])),
            float(np.median([o.whole for o in outcomes])),
        )
        cells = [f"{rms(of_kind):.2f}" for of_kind in errors.values()]
        cells += [f"{rms([e for of_kind in errors.values() for e in of_kind]):.2f}"]
        cells += [f"{1e3 * rms([outcome.held_out for outcome in outcomes]):.3f}"]
        cells += [f"{seconds:.3f}" + (f" ({whole:.3f})" if whole != seconds else "")]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    ratio = np.median([ours.seconds / theirs.seconds for ours, theirs in both])
    print(f"\nTime beside mujoco.sysid's, median of the robots' ratios: {ratio:.2f}", flush=True)


def rms(values: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def recorded(cases: Sequence[Case]) -> None:
    print("\n### an XL330 as it was recorded, each motion held out in turn: error over the full run, rad\n")
    print("| held out | given | Open Ant Tools | mujoco.sysid | time, s | its time, s |")
    print("|---|---|---|---|---|---|")
    rows = []
    for case in cases:
        a, b = ours(case), theirs(case)
        rows.append((judged(case, case.plant.model), a.held_out, b.held_out, a.seconds, b.seconds))
        given, us, them, seconds, its = rows[-1]
        print(f"| {case.title} | {given:.4f} | {us:.4f} | {them:.4f} | {seconds:.1f} | {its:.1f} |", flush=True)
    given, us, them = (rms([row[k] for row in rows]) for k in range(3))
    print(
        f"| all | {given:.4f} | {us:.4f} | {them:.4f} | {sum(r[3] for r in rows):.0f} | {sum(r[4] for r in rows):.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["servo", "far", "ant", "real"])
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "realdata")
    parser.add_argument("--robots", type=int, default=5, help="servos of other values and noise")
    parser.add_argument("--ants", type=int, default=2, help="Ants of other values and noise")
    options = parser.parse_args()
    wanted = [options.only] if options.only else ["servo", "far", "ant", "real"]
    with TemporaryDirectory() as made:
        folder = Path(made)
        if "servo" in wanted:
            known([servo(folder, False, seed) for seed in range(options.robots)])
        if "far" in wanted:
            known([servo(folder, True, seed) for seed in range(options.robots)])
        if "ant" in wanted:
            known([ant(folder, seed) for seed in range(options.ants)])
        if "real" in wanted and options.shared.is_dir():
            recorded(real(options.shared / "bam-xl330"))


if __name__ == "__main__":
    main()
