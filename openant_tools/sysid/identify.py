"""Identification from end to end: runs and a model in; values with intervals and verdicts, judged on held-out runs, out.

What is reported as better was measured on runs that neither the fit nor any choice saw. A parameter that the data cannot
determine stays at its prior; what runs that are left out of the fit in turn are followed better without, at the short horizon and
over full runs, goes back (`choice.py`). Runs that were held out judge once, and may only send all of it back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import acting
from openant_tools.effects.entries import check_pair, entries_of, values_of
from openant_tools.effects.rollout import EffectValues
from openant_tools.errors import BadInput
from openant_tools.model.attribute import Attribute
from openant_tools.model.floor import disagreement, floors
from openant_tools.model.gap import HORIZON_S, Gap, share_closed
from openant_tools.model.of_run import own_model, plants_of
from openant_tools.model.plant import Plant, Setup, load_plant, setup_of
from openant_tools.numbers import column, exact, number, percent, span
from openant_tools.recording.run import Run
from openant_tools.robot.config import EffectEntry as Entry
from openant_tools.sysid.choice import Choice, Fold, Settled, by_gain, by_motion, pays, pooled, settle
from openant_tools.sysid.dataset import Dataset, gaps, sensor_floor
from openant_tools.sysid.declared import Declaration, declared_parameters
from openant_tools.sysid.estimate import Estimate
from openant_tools.sysid.intervals import TWO_SIDED_95
from openant_tools.sysid.kinds import ACTUATOR_LAG, LOAD_FRICTION, SPEED_LIMIT, said
from openant_tools.sysid.parameter import (
    ACTION_DELAY,
    KINDS,
    Parameter,
    apply,
    buffered,
    by_register,
    choose,
    delays,
    effect_values,
    restatements,
    unloaded,
)  # fmt: skip
from openant_tools.sysid.problem import Problem
from openant_tools.sysid.quality import Telemetry, check_model, without_errors
from openant_tools.sysid.rules import check_runs, without_turns
from openant_tools.sysid.verdict import SILENT, Verdict, Word, experiment, verdicts

__all__ = [
    "DEFAULT_KINDS",
    "Identification",
    "Value",
    "applicable",
    "calibrated",
    "dataset_of",
    "identify",
    "joints_in_common",
    "restated",
]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

#: what is identified where nothing is said; `damping` stands for whichever of damping and velocity gain the model has
DEFAULT_KINDS = (
    "stiffness",
    "damping",
    "armature",
    "coulomb_friction",
    "zero_offset",
    "electrical_damping",
    ACTION_DELAY,
)

#: and with them, where a robot stood on the floor
ON_FLOOR = ("floor_friction", "contact_softness")

#: share of a run's samples that may be missing without a word
MISSING = 0.01
#: what is said where gains and torque limits follow it
FOLLOWED = (
    "Gains and torque limits follow the logged supply, in the given model and in the fitted one: at the nominal supply, as "
    "`openant gap measure` plays them, both leave other errors than are told here."
)
#: and where held-out runs sent back what was chosen
SENT_BACK = (
    "Held-out runs are not followed better by what was chosen ({} → {} over full runs, {} → {} at "
    + f"{exact(HORIZON_S, 's')}), so all of it goes back: they differ from the fitted runs in what these do not tell."
)
#: share by which a supply falls before it is worth a word: a servo measures it in steps of 0.1 V
SAG = 0.03
#: s; a row's time stamp may be off by this much without a word
STAMP_ERROR_S = 0.5e-3


@dataclass(frozen=True)
class Value:
    """What became of one parameter.

    Attributes:
        name: `kind.joint` (or `.servo model`, `.all`).
        unit: SI.
        joints: whose it is; none where it is the body's or the world's.
        given: the value in the given model (of the first joint where several are tied).
        value: the value in the written model.
        low, high: 95 % interval of the estimate; none where the value is not the data's.
        prior_low, prior_high: 95 % interval of the prior.
        verdict: `identified`, `weak` (between data and prior), `tied` (the data tell it only together with another),
            `conflict` (the data's, which contradict the prior), `not in the data` (left at its prior) or `fell back` (runs that
            the fit had not seen are followed better without it, or the data do not tell it from none).
        information: share of the precision that the data gave, 0…1.
        tied_to: the other parameter's name, where it is tied.
        record_next: what to record so that it becomes identified; empty where it is, or where nothing is known.
        halves: what each half of the data alone says, where they contradict each other; the interval holds both.
    """

    name: str
    unit: str
    joints: tuple[str, ...]
    given: float
    value: float
    low: float | None
    high: float | None
    prior_low: float
    prior_high: float
    verdict: Word
    information: float
    tied_to: str | None = None
    record_next: str = ""
    halves: tuple[float, float] | None = None

    @property
    def accepted(self) -> bool:
        return self.verdict not in SILENT

    @property
    def words(self) -> str:
        """The verdict for reading."""
        if self.verdict == "conflict":
            return f"conflict: the prior says {span(self.prior_low, self.prior_high, self.unit)}"
        return f"tied to {said(self.tied_to)}" if self.tied_to else self.verdict


@dataclass(frozen=True)
class Turn:
    """Runs that were left out of everything, choices included, and judged what came of the others.

    Attributes:
        runs: their names.
        samples: how many positions they have.
        chosen: by the folds within the others.
        before, after: the gap on the runs, of the given model and of what was chosen.
    """

    runs: tuple[str, ...]
    samples: int
    chosen: Choice
    before: Gap
    after: Gap


@dataclass(frozen=True)
class Identification:
    """The result of a fit.

    Attributes:
        model: the MJCF that was given.
        joints: what was fitted.
        values: every parameter.
        before, after: the gap on held-out runs, of the given and of the written model.
        floor: rad, what no model could beat on these runs, from repeats or the encoder's resolution.
        doubt: why that floor is none; "" where it holds.
        judged_on: names of the held-out runs; where none were given, of the runs left out in turn.
        turns: where runs were left out in turn, each judged by a fit to the others and a choice made anew without it.
        folds: names of the runs, or parts of them, that were left out together for `choice`.
        choice: what of the fit to all runs beats the given model on the folds.
        noise: joint → rad, residual deviation of the fit.
        correlation_s: joint → s, how long a residual remembers itself; far above the sample time it is model error.
        stamp_error_s: s, standard deviation by which time stamps miss the moments of sampling, row by row.
        u: (parameters,) of the written model, for `models`.
        acting: effects between steps that were given and acted as they are, in the given model and in the written one.
        notes: what a reader should know; checked: those of them that are what the rules noted.
        with_effects: the fit to the same runs that is better by effects which plain MuJoCo cannot play; None where none is.
    """

    model: Path
    joints: tuple[str, ...]
    values: tuple[Value, ...]
    before: Gap
    after: Gap
    floor: float
    judged_on: tuple[str, ...]
    turns: tuple[Turn, ...]
    folds: tuple[tuple[str, ...], ...]
    choice: Choice
    noise: Mapping[str, float]
    correlation_s: Mapping[str, float]
    stamp_error_s: float
    parameters: tuple[Parameter, ...]
    u: Array
    covariance: Array
    datasets: tuple[Dataset, ...]
    held_out: tuple[Dataset, ...]
    acting: EffectValues
    notes: tuple[str, ...]
    doubt: str = ""
    checked: tuple[str, ...] = ()
    with_effects: Identification | None = None

    @property
    def in_turn(self) -> bool:
        return bool(self.turns)

    @property
    def models(self) -> tuple[Path, ...]:
        """The files that the runs were made with: the given one, or each gain's own."""
        return tuple(dict.fromkeys(data.plant.path for data in self.datasets))

    @property
    def accepted(self) -> tuple[str, ...]:
        return tuple(value.name for value in self.values if value.accepted)

    @property
    def effects(self) -> dict[tuple[str, str], Array]:
        """(effect, its parameter) → (joints,) of what acts between the steps of the written model, found or given."""
        return effect_values(self.datasets[0].plant, self.parameters, self.u, self.acting)

    @property
    def effects_found(self) -> dict[tuple[str, str], Array]:
        """Those of `effects` that were fitted."""
        return effect_values(self.datasets[0].plant, self.parameters, self.u)

    def as_json(self) -> dict[str, Any]:
        """`fit.json` (formats, section 6)."""
        return {
            "schema": "openant.fit/1",
            "model": str(self.model),
            "joints": list(self.joints),
            "runs": [run.name for data in self.datasets for run in data.runs],
            "parameters": {
                value.name: {
                    "value": value.value,
                    "low": value.low,
                    "high": value.high,
                    "prior": [value.prior_low, value.prior_high],
                    "verdict": value.verdict,
                    "unit": value.unit,
                    "given": value.given,
                    "joints": list(value.joints),
                    "information": value.information,
                    "tied_to": value.tied_to,
                    "record_next": value.record_next,
                    "halves": None if value.halves is None else list(value.halves),
                }
                for value in self.values
            },
            "held_out": {
                "runs": list(self.judged_on),
                "in_turn": self.in_turn,
                "nested": self.in_turn,
                "before": self.before.as_json(),
                "after": self.after.as_json(),
                "floor_rad": self.floor,
                "doubt": self.doubt,
                "share_closed": share_closed(self.before.full, self.after.full, self.floor),
            },
            "chosen": {
                "folds": [list(names) for names in self.folds],
                "before": self.choice.before.as_json(),
                "after": self.choice.after.as_json(),
                "measured_supply": self.datasets[0].measured_supply,
            },
            "accepted": list(self.accepted),
            "acting": [
                {"effect": entry.effect, "joints": list(entry.joints), "parameters": dict(entry.parameters)}
                for entry in entries_of(self.acting, self.joints)
            ],
            "noise_rad": dict(self.noise),
            "residual_correlation_s": dict(self.correlation_s),
            "stamp_error_s": self.stamp_error_s,
            "notes": list(self.notes),
        }


def identify(
    runs: Sequence[Run],
    model: Path,
    hold_out: Sequence[Run] = (),
    *,
    joints: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    also: Sequence[str] = (),
    tie: str = "joint",
    declared: Declaration | None = None,
    measured_supply: bool | None = False,
    tempered: bool = False,
    effects: Sequence[Entry] = (),
    checked: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Fit `model` to `runs`, choose what of it is kept by folds within them, and judge that once on `hold_out`; without those by
    leaving out runs in turn, each judged by a fit and a choice that had no part of it.

    Args:
        runs: what to fit; each may name its own model of the same joints (formats, section 1).
        model: the MJCF whose values are the priors and into which the result goes.
        hold_out: runs that fit and choice must not see; if what was chosen does not beat the given model on them, all goes back.
        joints: which joints to fit; default every position-controlled joint that all runs command and measure.
        kinds: keys of KINDS; default what `declared` asks for, else DEFAULT_KINDS as far as they apply.
        also: keys of KINDS besides the default ones.
        tie: `joint` (each its own values), `servo` (one value for all joints of a servo model) or `all`.
        declared: parameters that a user declared, fitted besides.
        measured_supply: gains and torque limits follow the voltage that the runs logged, in the given model too; None: if what
            is left out of the fit is followed better so.
        tempered: all runs count alike (`Problem`).
        effects: `[[effect]]` entries that the robot has: those that act between steps act in every simulation as they are,
            unless they are fitted themselves.
        checked: what `check_runs` noted of all these runs, where they have gone through it before; default they do now.
        progress: called with what is being done and the share that is done.

    Raises:
        BadInput: no runs, no joints in common, no motion, a held-out run that is also fitted, a model that fails, or effects
            that were fitted with another model.
    """
    everything = [*runs, *hold_out]
    same = {id(run) for run in runs} & {id(run) for run in hold_out} or (
        {run.path for run in runs if run.path} & {run.path for run in hold_out if run.path}
    )
    if same:
        raise BadInput("a held-out run is also fitted", remedy="hold out runs that are not among those to fit")
    joints = joints_in_common(everything, model, joints)
    said = check_runs(everything, plants_of(everything, model, joints)) if checked is None else tuple(checked)
    cleaned = [without_errors(without_turns(run, joints), joints) for run in everything]
    everything, telemetry = [run for run, _ in cleaned], [found for _, found in cleaned]
    runs, hold_out = everything[: len(runs)], everything[len(runs) :]
    floored = load_plant(model, joints, Setup.FLOOR)
    wanted = applicable(
        declared.kinds if kinds is None and declared else kinds,
        floored,
        limp=any((run.signal("torque", joints, default=1.0) == 0).any() for run in runs)
        # What brakes in the motor never reaches the gears, so that a friction that follows their load tells it apart.
        or LOAD_FRICTION in also,
        on_floor=any(setup_of(run.facts.setup) is Setup.FLOOR for run in runs),
        also=also,
    )
    logged = any(run.facts.supply_v and run.has("volt", [joints[0]]) for run in runs)
    if measured_supply and not logged:
        raise BadInput(
            "no run has both a logged voltage (volt.*) and its nominal supply (supply_v)",
            remedy="leave --measured-supply out, or say supply_v in the run's facts",
        )

    played = _played(effects, wanted)
    acting = values_of(played, joints)

    def datasets(of: Sequence[Run], supply: bool) -> list[Dataset]:
        return _datasets(of, model, joints, wanted, supply, acting)

    supplies = (False, True) if measured_supply is None and logged else (bool(measured_supply),)
    data, judged = datasets(runs, supplies[0]), datasets(hold_out, supplies[0])
    for one in (*data, *judged):
        beside = check_pair(played, one.plant.model, one.plant.path)
        # An effect that is fitted makes a pair of its own.
        said += tuple(beside) if played or not any(KINDS[kind].effect for kind in wanted) else ()
    for one in (*data, *judged):
        given = one.simulate((), [np.zeros(0)]).pos[0]
        for run, rows in zip(one.runs, one.fitted.rows, strict=True):
            check_model(run, one.plant, given[rows])
    plant = data[0].plant
    motors = {k: v for run in everything for k, v in run.facts.motors.items()}
    chosen = by_register(choose(plant, wanted, tie, motors), [one.plant for one in data])
    if LOAD_FRICTION in wanted:
        chosen = [unloaded(parameter, plant) for parameter in chosen]
    chosen += declared_parameters(plant, declared) if declared else []
    floor = np.maximum(sensor_floor(runs, joints), 1e-6)

    motions = by_motion(runs, joints)
    gains = by_gain(runs, lambda run: own_model(run) or model)
    turns = () if hold_out else motions
    total = 2 * len(supplies) + 1  # each a fit and its folds; and judging

    def share(part: int) -> Progress | None:
        return progress and (lambda done, what: progress((part + done) / total, what))

    ways = list[tuple[Problem, Estimate, list[Settled]]]()
    for supply in supplies:
        problem = Problem(data if supply == supplies[0] else datasets(runs, supply), chosen, floor, tempered)
        start = ways[0][1].u if ways else None
        estimate = problem.solve(start, share(2 * len(ways)))
        prepare = partial(datasets, supply=supply)
        ways.append(
            (problem, estimate, settle(problem, estimate, motions, gains, turns, prepare, share(2 * len(ways) + 1)))
        )
    # What is chosen of all runs comes first, then what is chosen anew without each turn.
    best, *anew = (
        1 if len(each) > 1 and pays(each[1].choice, each[0].choice) else 0
        for each in zip(*(settled for *_, settled in ways), strict=True)
    )
    problem, estimate, (settled, *_) = ways[best]
    data, kept, u = list(problem.datasets), settled.choice.kept, settled.u
    if progress:
        progress((total - 1) / total, "judging what was chosen")
    sent_back = list[str]()
    told = [_turn(ways[way][2][1 + k], fold, chosen) for k, (way, fold) in enumerate(zip(anew, turns, strict=True))]
    if told:
        samples = [turn.samples for turn in told]
        before, after = (pooled([getattr(turn, end) for turn in told], samples) for end in ("before", "after"))
        if not kept.any():
            after = before  # it is the given model that is written, whatever came of fewer runs
    else:
        judged = judged if data[0].measured_supply == supplies[0] else datasets(hold_out, True)
        before, after = gaps(judged, chosen, [np.zeros(len(chosen)), u])
        if not (after.horizon < before.horizon and after.full < before.full):
            left = (before.full, after.full, before.horizon, after.horizon)
            sent_back.append(SENT_BACK.format(*(number(rad, "rad", name="error") for rad in left)))
            kept, u, after = np.zeros(len(chosen), bool), np.zeros(len(chosen)), before
    found = verdicts(estimate, kept)
    values = tuple(
        _value(p, next(one.plant for one in data if p.belongs(one.plant)), estimate, k, found[k], float(u[k]))
        for k, p in enumerate(chosen)
    )
    return Identification(
        model=model,
        joints=tuple(joints),
        values=values,
        before=before,
        after=after,
        floor=float(np.sqrt(np.mean(floors([*runs, *hold_out], joints)[0] ** 2))),
        doubt=(doubt := disagreement([*runs, *hold_out], joints)),
        judged_on=tuple(run.name for run in hold_out) or tuple(name for turn in told for name in turn.runs),
        turns=tuple(told),
        folds=tuple(tuple(run.name for run in fold.runs) for fold in (*motions, *gains)),
        choice=settled.choice,
        noise=dict(zip(joints, estimate.noise.tolist(), strict=True)),
        correlation_s=dict(zip(joints, estimate.correlation_s.tolist(), strict=True)),
        stamp_error_s=estimate.stamp_error_s,
        parameters=tuple(chosen),
        u=u,
        covariance=estimate.covariance,
        datasets=tuple(data),
        held_out=tuple(judged or data),
        acting=acting,
        checked=said,
        notes=(
            *dict.fromkeys(said),
            *([doubt] if doubt else []),
            *sent_back,
            *_telemetry_notes(everything, telemetry),
            *_acting_notes(acting),
            *([FOLLOWED] if data[0].measured_supply else _supply_notes(everything, joints)),
            *_notes(estimate, joints, runs, values),
        ),
    )


def _turn(settled: Settled, fold: Fold, parameters: Sequence[Parameter]) -> Turn:
    before, after = gaps(settled.unseen, parameters, [np.zeros(len(parameters)), settled.u])
    return Turn(tuple(run.name for run in fold.runs), settled.samples, settled.choice, before, after)


def joints_in_common(runs: Sequence[Run], model: Path, wanted: Sequence[str] | None) -> list[str]:
    """The joints of a model, or those `wanted`, that every run commands and measures.

    Raises:
        BadInput: there are no runs, no such joints, or a run lacks one that is wanted.
    """
    if not runs:
        raise BadInput("no runs to fit", remedy="name at least one recording")
    plant = load_plant(model, wanted, Setup.FLOOR)
    missing: dict[str, str] = {}
    for run in runs:
        for joint in plant.joints:
            for signal in ("cmd", "pos"):
                if not run.has(signal, [joint]):
                    missing.setdefault(joint, f"{run.path or run.name} has no {signal}.{joint}")
    common = [joint for joint in plant.joints if joint not in missing]
    if wanted is not None and missing:
        raise BadInput("; ".join(missing.values()), remedy="choose joints that every run commands and measures")
    if not common:
        raise BadInput(
            f"the model's joints ({', '.join(plant.joints)}) are not those of the runs ({', '.join(runs[0].joints)})",
            where=model,
            remedy="give the model of this robot, with joints named as in the runs",
        )
    return common


def _played(entries: Sequence[Entry], kinds: Sequence[str]) -> list[Entry]:
    """The robot's entries that act between steps, without the effects that are fitted.

    What the rest of a model carries (a written delay, a hinge with play) is in the model already.
    """
    fitted = {key[0] for kind in kinds if (key := KINDS[kind].effect) is not None}
    return [entry for entry in entries if entry.effect in acting() and entry.effect not in fitted]


def _datasets(
    runs: Sequence[Run],
    model: Path,
    joints: Sequence[str],
    kinds: Sequence[str],
    measured_supply: bool,
    acting: EffectValues,
) -> list[Dataset]:
    """One dataset per model and setup; runs that name their own model are simulated with it."""
    groups: dict[tuple[Path, Setup], list[Run]] = {}
    for run in runs:
        groups.setdefault((own_model(run) or model, setup_of(run.facts.setup)), []).append(run)
    return [
        Dataset.prepare(
            load_plant(path, joints, setup, electrical="electrical_damping" in kinds, lagging=ACTUATOR_LAG in kinds),
            members,
            measured_supply=measured_supply,
            acting=acting,
        )
        for (path, setup), members in groups.items()
    ]


def dataset_of(identification: Identification, run: Run) -> Dataset:
    """Another run, prepared to be simulated with what was identified: with `parameters` at `u`."""
    kinds = [parameter.kind for parameter in identification.parameters]
    fitted = identification.datasets[0]
    return _datasets(
        [run], identification.model, identification.joints, kinds, fitted.measured_supply, identification.acting
    )[0]


def applicable(
    kinds: Sequence[str] | None, plant: Plant, *, limp: bool, on_floor: bool, also: Sequence[str] = ()
) -> list[str]:
    """The kinds to fit: those named, else the default ones; `also` besides.

    Of damping and velocity gain what stands in the model: torque clips the one and not the other, and
    while it neither saturates nor is switched off only their sum shows, which priors then share out. The electrical share of
    damping shows only without torque or in what load the gears carry, what decides at the floor only on it. (The torso's mass is a torque scale to a standing
    robot: it must be asked for.)

    Args:
        plant: the model with its position servos as they are (no motors).
        limp: whether torque is off for a while, or the load of the gears counts.
        on_floor: whether the robot stands on the floor.

    Raises:
        BadInput: there is no such kind, or two of them are words for one thing.
    """
    wanted = [*(_by_default(plant, limp=limp, on_floor=on_floor) if kinds is None else kinds), *also]
    unknown = [kind for kind in wanted if kind not in KINDS]
    if unknown:
        raise BadInput(f"no such parameter: {', '.join(unknown)}", remedy=f"choose from {', '.join(KINDS)}")
    if SPEED_LIMIT in wanted and "damping" in wanted:
        raise BadInput(
            "speed_limit and damping are two words for one thing: the speed limit is torque limit over damping",
            remedy="fit one of them",
        )
    return [kind for kind in KINDS if kind in wanted]


def _by_default(plant: Plant, *, limp: bool, on_floor: bool) -> list[str]:
    in_joint = sum(KINDS["damping"].read(plant.model, plant, j) for j in range(len(plant.joints)))
    in_servo = sum(KINDS["velocity_gain"].read(plant.model, plant, j) for j in range(len(plant.joints)))
    out = []
    for kind in DEFAULT_KINDS:
        if kind == "damping" and in_servo > 0:
            out.append("velocity_gain")
            if in_joint == 0:
                continue
        if kind == "electrical_damping" and not limp:
            continue
        out.append(kind)
    if plant.free_joint is not None and on_floor:
        out += ON_FLOOR
    return out


def _value(parameter: Parameter, plant: Plant, estimate: Estimate, k: int, verdict: Verdict, u: float) -> Value:
    kind = parameter.definition
    nominal = kind.read(plant.model, plant, parameter.joints[0])
    deviation = TWO_SIDED_95 * math.sqrt(estimate.covariance[k, k])

    def physical(end: float) -> float:
        return float(np.clip(parameter.value(nominal, end), kind.low, kind.high))

    # The value is the best for this model with its time step; the interval reaches to where the robot's own lies.
    ends = [u + shift + side for shift in (0.0, float(estimate.step_shift[k])) for side in (-deviation, deviation)]
    halves = None
    if verdict.contradictory:
        ends += estimate.halves[:, k].tolist()
        first, second = (parameter.value(nominal, half) for half in estimate.halves[:, k].tolist())
        halves = (first, second)
    other = None if verdict.tied_to is None else estimate.parameters[verdict.tied_to]
    wanting = verdict.word in ("weak", "tied", "not in the data")
    return Value(
        name=parameter.name,
        unit=kind.unit,
        joints=() if kind.body else tuple(plant.joints[j] for j in parameter.joints),
        given=nominal,
        value=parameter.value(nominal, u),
        low=None if verdict.word in SILENT else physical(min(ends)),
        high=None if verdict.word in SILENT else physical(max(ends)),
        prior_low=physical(float(estimate.centre[k]) - TWO_SIDED_95),
        prior_high=physical(float(estimate.centre[k]) + TWO_SIDED_95),
        verdict=verdict.word,
        information=float(estimate.information[k]),
        tied_to=None if other is None else other.name,
        record_next=experiment(parameter.kind, None if other is None else other.kind) if wanting else "",
        halves=halves,
    )


def _telemetry_notes(runs: Sequence[Run], telemetry: Sequence[Telemetry]) -> Iterator[str]:
    """What was left out as no measurement, and whose it was."""
    spiked = [
        f"{n} of pos.{joint} in {run.name}"
        for run, found in zip(runs, telemetry, strict=True)
        for joint, n in found.glitches.items()
    ]
    if spiked:
        yield f"Samples that stand alone far from their neighbours are errors of telemetry and left out: {', '.join(spiked)}."
    lost = [
        f"{percent(n / len(run.t))} of pos.{joint} in {run.name}"
        for run, found in zip(runs, telemetry, strict=True)
        for joint, n in found.missing.items()
        if n > MISSING * len(run.t)
    ]
    if lost:
        yield f"Samples are missing: {', '.join(lost)}. `openant comms diagnose` names why."


def _acting_notes(acting: EffectValues) -> Iterator[str]:
    if acting:
        names = list(dict.fromkeys(name for name, _ in acting))
        yield (
            f"What robot.toml says of {', '.join(names)} acted in every simulation as it stands there. Fit it too with "
            f"{' '.join(f'--also {name}' for name in names)}, or set enabled = false."
        )


def _supply_notes(runs: Sequence[Run], joints: Sequence[str]) -> Iterator[str]:
    """Which runs logged a supply that is not the nominal one."""
    low = {}
    for run in runs:
        if run.facts.supply_v and run.has("volt", joints):
            volts = float(np.nanquantile(run.signal("volt", joints), 0.05))
            if volts < (1 - SAG) * run.facts.supply_v:
                low[run.name] = f"{number(volts, decimals=1)} of {exact(run.facts.supply_v, 'V')} in {run.name}"
    if low:
        yield (
            f"The supply fell to {', '.join(low.values())}, and gains and torque limits with it: `--measured-supply` lets them "
            "follow what was logged."
        )


def _notes(estimate: Estimate, joints: Sequence[str], runs: Sequence[Run], values: Sequence[Value]) -> tuple[str, ...]:
    notes = []
    torn = [
        f"{said(value.name)} ({' and '.join(column(value.halves, value.unit))})" for value in values if value.halves
    ]
    if torn:
        notes.append(
            f"Two halves of the data contradict each other about {', '.join(torn)}: the robot changed between them, or the "
            "model lacks what they differ in. One value for both is no average to rely on; the interval holds both. Fit the "
            "halves apart and see `openant sysid compare`."
        )
    if estimate.stamp_error_s > STAMP_ERROR_S:
        notes.append(
            f"Time stamps miss the moments of sampling by {number(estimate.stamp_error_s, 's')} (standard deviation, row by "
            "row). Fast motion counts for less because of it."
        )
    if not estimate.converged:
        notes.append("The optimiser stopped before its tolerance was met: read the values with care.")
    period = float(np.median(np.concatenate([np.diff(run.t) for run in runs])))
    lasting = [joint for joint, time in zip(joints, estimate.correlation_s, strict=True) if time > 10 * period]
    if lasting:
        notes.append(
            f"The residuals of {', '.join(lasting)} remember themselves for many samples: what is left there is model "
            "error, not noise. Intervals are widened for it; `openant gap diagnose` names causes."
        )
    return tuple(notes)


def calibrated(identification: Identification, setup: Setup = Setup.FLOOR, path: Path | None = None) -> mujoco.MjModel:
    """The identified model. Its servos become DC motors only where a part of the damping was found to be electrical.

    Args:
        path: which of the identification's models; default the given one.
    """
    moved = {p.kind for p, u in zip(identification.parameters, identification.u, strict=True) if u != 0}
    plant = load_plant(
        path or identification.model,
        identification.joints,
        setup,
        electrical="electrical_damping" in moved,
        delayed=ACTION_DELAY in moved,
        lagging=ACTUATOR_LAG in moved,
    )
    model = apply(plant, identification.parameters, identification.u)
    if ACTION_DELAY in moved:
        buffered(plant, model, delays(plant, identification.parameters, identification.u))
    return model


def restated(identification: Identification, path: Path | None = None) -> dict[Attribute, tuple[float, ...]]:
    """What the attributes that were declared are in an identified model's file, where they moved."""
    return restatements(path or identification.model, identification.parameters, identification.u)
