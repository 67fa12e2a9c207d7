"""When each command arrived, as far as joints show it.

A servo that gets a command late stays behind by what the command would have moved it meanwhile: by how much, for every row from
then on, its stiffness, damping and inertia say. Of every command of a run that is a direction in which a log differs from the
model. How far logs go along all of them, beyond what tolerances of a servo do, is the locally best test of whether commands
arrive irregularly (a score test of a variance; Rao 1948); whether some are late and none early tells lost commands from a
jittering clock; and whether joints say the same of one command, whether one packet brought it to all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, hstack

from openant_tools.gap.neighbours import against_neighbours
from openant_tools.model.plant import Plant
from openant_tools.model.servo import read_damping, read_stiffness, read_velocity_gain
from openant_tools.recording.run import Run

__all__ = ["KINDS_OF_ONE", "LATE_S", "Arrivals", "natural_modes", "step_response"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

#: what is said of each joint, and of all together
KINDS_OF_ONE = ("size", "skew")
#: s: how late a command is taken to be where the direction is found, how long a servo answers, and of its answer's steps
LATE_S, ANSWERS_S, STEP_S = 0.004, 0.6, 0.0005
#: commands that are looked at side by side
PORTION = 256
#: rad/s between which a servo's natural frequency is believed
NATURAL_RAD_S = (3.0, 600.0)
#: rad/s at which dry friction has turned, on the way to what it is
TURNS_RAD_S = 0.05
#: share of what commands show on average that is added to each: those that hardly move a joint say nothing of when they came
HARDLY = 1.0
#: s, what no log tells; and beyond how many deviations a command counts as so many
LEAST_S, FARTHEST = 1e-5, 4.0


@dataclass(frozen=True)
class Arrivals:
    """The commands of one run and what each does to its joint.

    Attributes:
        t: (rows,) s. counts: (rows,) which are looked at.
        behind: of each joint, (rows, commands) rad beside the rows about for each second that a command is late.
        command: (rows, joints) rad in force.
    """

    t: Array
    counts: Bools
    behind: tuple[csr_array, ...]
    command: Array

    @classmethod
    def of(cls, run: Run, plant: Plant, counts: Bools) -> Arrivals:
        """The commands of a run, for the servos of a model.

        Args:
            counts: (rows,) which rows are looked at.
        """
        t, sent = run.t - run.t[0], run.command_times - run.t[0]
        commands = run.signal("cmd", plant.joints)
        natural, damped = natural_modes(run, plant)
        late, held = [], np.zeros(commands.shape)
        for j in range(len(plant.joints)):
            given = np.isfinite(commands[:, j])
            order = np.argsort(sent[given], kind="stable")
            times, values = sent[given][order], commands[given, j][order]
            if not len(values):
                late.append(csr_array((len(t), 0)))
                continue
            held[:, j] = values[np.maximum(np.searchsorted(times, t, side="right") - 1, 0)]
            late.append(_answers(t, times, np.diff(values, prepend=values[0]), natural[j], damped[j], counts))
        return cls(t, counts, tuple(late), held)

    def __call__(self, x: Floats, simulated: Floats) -> tuple[Array, Array, Array]:
        """How late commands came to some robots.

        Args:
            x: (robots, rows, joints) rad off the model, NaN where nobody knows. simulated: (rows, joints) rad, the model's.

        Returns:
            (robots, joints + 1) logarithm of their scatter, s, for each joint and for all together; as many of their skewness,
            towards late; (robots, 1) how much more alike joints are in that than by chance, as a share of what they scatter.
        """
        off = against_neighbours(x, self.t) * self.counts[:, None]
        model = np.gradient(simulated.astype(np.float64), self.t, axis=0)
        said = []
        for j, answers in enumerate(self.behind):
            usual = self._usual(simulated[:, j].astype(np.float64), model[:, j], self.command[:, j])
            left = off[:, :, j] - (off[:, :, j] @ usual) @ usual.T
            shows = np.asarray(answers.multiply(answers).sum(axis=0)) - np.square(answers.T @ usual).sum(axis=1)
            said.append(((answers.T @ left.T).T, np.maximum(shows, 0.0)))
        commanded = [(along, shows) for along, shows in said if len(shows)]
        if len({len(shows) for _, shows in commanded}) == 1:
            together, shows = (
                np.sum([along for along, _ in commanded], axis=0),
                np.sum([one for _, one in commanded], axis=0),
            )
            apart = np.sum([np.square(along) for along, _ in commanded], axis=(0, 2))
            shared = (np.square(together).sum(axis=1) - apart) / np.maximum(apart, 1e-30)
            said.append((together, shows))
        else:
            # Joints that are commanded at different times have no packet in common.
            shared = np.zeros(len(x))
            said.append(said[0])
        sizes, skews = zip(*(_scatter(along, shows) for along, shows in said), strict=True)
        return np.stack(sizes, axis=1), np.stack(skews, axis=1), shared[:, None]

    def _usual(self, position: Array, speed: Array, command: Array) -> Array:
        """(rows, directions), orthonormal: what a servo within its tolerances does otherwise than the model, to first order."""
        turn, error = np.tanh(speed / TURNS_RAD_S), command - position
        acceleration = np.gradient(speed, self.t)
        every = [
            speed, acceleration, np.gradient(acceleration, self.t), error, np.roll(error, 1), np.roll(error, -1),
            turn, np.roll(turn, 1), position, speed * np.abs(speed), error * np.abs(error),
        ]  # fmt: skip
        near = against_neighbours(np.stack(every, axis=1)[None].astype(np.float32), self.t)[0] * self.counts[:, None]
        size = np.linalg.norm(near, axis=0)
        out: Array = np.linalg.qr(near[:, size > 1e-9] / size[size > 1e-9])[0]
        return out


def natural_modes(run: Run, plant: Plant) -> tuple[Array, Array]:
    """(joints,) natural frequencies, rad/s, and damping ratios of a model's servos where a run begins."""
    model, data = plant.model, mujoco.MjData(plant.model)
    data.qpos[plant.qpos] = np.nan_to_num(run.signal("pos", plant.joints)[0])
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    own = np.maximum(inertia[plant.dof, plant.dof], 1e-9)
    joints = range(len(plant.joints))
    stiffness = np.array([max(read_stiffness(model, plant, j), 1e-9) for j in joints])
    damping = np.array([read_damping(model, plant, j) + read_velocity_gain(model, plant, j) for j in joints])
    return np.clip(np.sqrt(stiffness / own), *NATURAL_RAD_S), damping / (2 * np.sqrt(stiffness * own))


def _answers(t: Array, times: Array, steps: Array, natural: float, damped: float, counts: Bools) -> csr_array:
    """(rows, commands) as `Arrivals.behind`: what rows lie behind, beside those about them, for each second a step is late."""
    grid = np.arange(0.0, ANSWERS_S + STEP_S, STEP_S)
    position = step_response(grid, natural, damped)
    found = []
    for at in range(0, len(times), PORTION):
        since = t[:, None] - times[at : at + PORTION]
        behind = np.interp(since - LATE_S, grid, position, left=0.0) - np.interp(since, grid, position, left=0.0)
        behind = np.where(since < ANSWERS_S, behind / LATE_S * steps[at : at + PORTION], 0.0)
        found.append(csr_array(against_neighbours(behind[None].astype(np.float32), t)[0] * counts[:, None]))
    return csr_array(hstack(found))


def step_response(t: Array, natural: float, damped: float) -> Array:
    """Of a second-order system, the share of a step that it has gone t after it."""
    root = np.sqrt(complex(damped**2 - 1))
    if abs(root) < 1e-3:
        root = complex(1e-3)
    slow, fast = natural * (damped - root), natural * (damped + root)
    out: Array = np.real(1 - (fast * np.exp(-slow * t) - slow * np.exp(-fast * t)) / (fast - slow))
    return out


def _scatter(along: Array, shows: Array) -> tuple[Array, Array]:
    """(robots,) logarithm of the scatter, s, and skewness of commands, by how far logs go (robots, commands) along each's answer.

    Args:
        shows: (commands,) how far a log goes along each that came a second late.
    """
    if not shows.any():
        return np.full(len(along), np.log10(LEAST_S)), np.zeros(len(along))
    hardly = HARDLY * shows.mean()
    weight = np.square(shows) / (shows + hardly)
    scatter = np.sqrt((np.square(along) / (shows + hardly)).sum(axis=1) / weight.sum()) + LEAST_S
    late = along / np.maximum(shows, 1e-3 * shows.max())
    cubed = np.clip(late / scatter[:, None], -FARTHEST, FARTHEST) ** 3
    return np.log10(scatter), np.arcsinh((cubed * weight).sum(axis=1) / weight.sum())
