"""Identification as plain functions, for scripts and notebooks: load → check → fit → judge → report (docs/python.md).

What `openant sysid fit` does with files these do with runs in memory, by the same rules, fit and judge. Angles are in rad, times
in s, all else in SI. What cannot be used raises BadInput, whose message says in one line what is wrong, where, and what to do.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openant_tools.effects.entries import check_pair, read_effects, values_of
from openant_tools.errors import BadInput
from openant_tools.model.floor import disagreement, floors
from openant_tools.model.gap import HORIZON_S, Gap, gap
from openant_tools.model.of_run import models_of, own_model, plants_of, with_model
from openant_tools.model.plant import Plant, load_plant, setup_of
from openant_tools.numbers import exact, number
from openant_tools.recording.facts import with_facts
from openant_tools.recording.plausibility import check_run
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run, run_of_columns
from openant_tools.robot.config import EffectEntry
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.pair import strangers
from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.declared import Declaration
from openant_tools.sysid.effect_fit import brakes_alike, with_effects
from openant_tools.sysid.identify import Identification, Progress, Value, dataset_of, identify, joints_in_common
from openant_tools.sysid.kinds import ELECTRICAL_DAMPING, said
from openant_tools.sysid.quality import without_errors
from openant_tools.sysid.result import stating_both, write_fit, write_robot
from openant_tools.sysid.rules import Finding, check_runs, findings, with_rows, without_turns

__all__ = [
    "BadInput", "Finding", "Gap", "Identification", "Judgement", "Run", "Value", "check", "fit", "judge", "load", "report",
    "summary",
]  # fmt: skip

Array = NDArray[np.float64]
#: a file's name
File = str | os.PathLike[str]


def load(
    source: File | Mapping[str, ArrayLike], *, name: str | None = None, facts: Mapping[str, Any] | None = None
) -> Run:
    """A run: what was commanded and what was measured, checked value by value (docs/recordings.md).

    Args:
        source: a recording (.mcap) or a table (.parquet, .csv), with or without its suffix; or columns in memory, name → (n,)
            values: `t` in s, `cmd.J` and `pos.J` in rad of each joint J, whatever else was logged. A data frame will do.
        name: what the run is called in reports; default the file's name, or `run`.
        facts: what is known besides the samples, as in the JSON beside a table: `setup`, `motors`, `supply_v`, `repeat_of` …;
            to what a file says itself they are added.

    Raises:
        BadInput: there is no such file, or the column and the row of what cannot be.
    """
    if isinstance(source, str | os.PathLike):
        run = read_run(os.fspath(source))
    elif hasattr(source, "items"):  # a data frame has them, and is no Mapping
        run = run_of_columns(source, name=name or "run")
    else:
        raise BadInput(
            f"a run is a file or columns by their names, not {type(source).__name__}",
            remedy='give a path, {"t": …, "cmd.J": …, "pos.J": …} or a data frame of pandas',
        )
    if facts:
        where = run.path or name or run.name
        run = replace(run, facts=with_facts(run.facts, facts, f"{where}, its facts"))
        if "joints" in facts:  # all else in it says nothing of the columns
            check_run(run, str(where))
    return replace(run, name=name or run.name)


def check(
    runs: Run | Sequence[Run], model: File | None = None, *, joints: Sequence[str] | None = None
) -> tuple[Finding, ...]:
    """What is implausible in runs and between them and their model, by the table of rules in docs/identify.md.

    Nothing is refused here: `finding.verdict` says what a fit will make of it, `str(finding)` where it is and what to do.

    Args:
        runs: as `load` gives them.
        model: the MJCF of all runs; default of each run its own, and where it names none the rules that need no model.
        joints: those to look at; default all that are both commanded and measured.

    Raises:
        BadInput: the model cannot be loaded, or has none of the joints.
    """
    out: list[Finding] = []
    for run in _listed(runs):
        source = own_model(run) if model is None else Path(model)
        if source is None:
            common = [joint for joint in joints or run.joints if run.has("cmd", [joint]) and run.has("pos", [joint])]
            out += findings(run, common)
        else:
            common = joints_in_common([run], source, joints)
            out += findings(run, common, load_plant(source, common, setup_of(run.facts.setup)))
    return tuple(out)


def fit(
    runs: Run | Sequence[Run],
    model: File | None = None,
    hold_out: Run | Sequence[Run] = (),
    *,
    robot: File | None = None,
    joints: Sequence[str] | None = None,
    kinds: Sequence[str] | None = None,
    also: Sequence[str] = (),
    tie: str = "joint",
    declared: Declaration | None = None,
    measured_supply: bool = False,
    beyond_mujoco: bool = True,
    tell: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Fit a model to runs, and judge it on runs that the fit has not seen.

    The result has `values` (each with interval and verdict), `before` and `after` (the gap on held-out runs, rad), `floor` (rad,
    what no model could beat) and `notes`. What does not beat the given model on folds that are left out of the fit, by motion and
    by gain, goes back to it.

    Args:
        runs: what to fit. Where they name models of their own that differ in their gains, they are of one servo.
        model: the MJCF of all runs, whose values are the priors; default of each run its own, else the robot's.
        hold_out: runs to judge by, once: no choice sees them, and if what was chosen does not beat the given model there, all of
            it goes back. Without, the fitted ones are left out in turn, each judged by a fit and choices made without it.
        robot: a robot's folder: its model where a run names none, and the effects in its robot.toml, which act as they are.
        joints: those to fit; default every position-controlled joint that all runs command and measure.
        kinds: nothing but these kinds of parameters (docs/identify.md); default what applies.
        also: kinds besides the default ones.
        tie: `joint` (each its own values), `servo` (one for all joints of a servo model) or `all`.
        declared: other numbers of the MJCF, as `sysid.declared.read_declarations` reads them.
        measured_supply: gains and torque limits follow the voltage that the runs logged, in the given model too.
        beyond_mujoco: try, too, what MuJoCo has no feature for, unless kinds were named: where that follows runs left out of the
            fit better, it is `result.with_effects`. If not, the robot's effects of another model do not act, either.
        tell: called before the fit begins with each note of the rules, which `notes` have as well.
        progress: called with what is being done and the share that is done, 0…1.

    Raises:
        BadInput: no runs, no model, no joints in common, a rule that refuses (see `check`), a held-out run that is also
            fitted, or a model that fails.
    """
    (runs, few), (hold_out, fewer) = with_rows(_listed(runs)), with_rows(_listed(hold_out))
    everything, given, named = _modelled([*runs, *hold_out], model, robot)
    said = (*few, *fewer, *named)
    if tell:
        for line in said:
            tell(line)
    plants = plants_of(everything, given, joints_in_common(everything, given, joints))
    noted = check_runs(everything, plants, tell=tell)
    runs, hold_out = everything[: len(runs)], everything[len(runs) :]
    effects = () if robot is None else RobotFolder.at(Path(robot)).config().effects
    if not beyond_mujoco:  # a plain model takes the place of the robot's pair, wherever it comes from
        others = strangers(effects, load_plant(given).model)
        effects = tuple(entry for entry in effects if entry not in others)
    plain = partial(
        identify,
        runs,
        given,
        hold_out,
        joints=joints,
        kinds=kinds,
        tie=tie,
        declared=declared,
        measured_supply=measured_supply,
        effects=effects,
        checked=(*said, *noted),
        progress=progress,
    )
    found = plain(also=also)
    # A list of kinds that was given is the builder's word that nothing else is wanted.
    if not beyond_mujoco or kinds or (declared and declared.kinds):
        return found
    tried = with_effects(
        found,
        runs,
        hold_out,
        also=also,
        tie=tie,
        declared=declared,
        measured_supply=measured_supply,
        effects=effects,
        progress=progress and (lambda done, what: progress(done, f"with effects: {what}")),
    )
    if tried and brakes_alike(found, tried):
        found = plain(also=[*also, ELECTRICAL_DAMPING])
    return stating_both(found, tried) if tried else found


@dataclass(frozen=True, repr=False)
class Judgement:
    """One model on some runs.

    Attributes:
        model: its name.
        joints: those compared.
        runs: as they were compared: without errors of telemetry (NaN) and whole turns.
        gap: rad, root mean square of measured minus simulated position over all joints and samples: `horizon`,
            re-initialised from measurement every 0.5 s, and `full`, over full runs.
        floor: rad, what no model could beat on these runs, by their repeats or their sensors.
        doubt: why that floor is none; "" where it holds.
        simulated: of each run, (rows, joints) rad, over the full run.
        by_joint: joint → rad, its own gap over full runs.
        notes: what the rules say of runs and model, a line each.
    """

    model: str
    joints: tuple[str, ...]
    runs: tuple[Run, ...]
    gap: Gap
    floor: float
    doubt: str
    simulated: tuple[Array, ...]
    by_joint: Mapping[str, float]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"{self.model}: full run {_error(self.gap.full)}, {exact(HORIZON_S, 's')} {_error(self.gap.horizon)}, "
            f"floor {_error(self.floor)}"
        )


def judge(
    runs: Run | Sequence[Run],
    model: File | Identification | None = None,
    *,
    effects: File | None = None,
    robot: File | None = None,
    joints: Sequence[str] | None = None,
) -> Judgement:
    """How far a model is from what was measured: any model, on any runs. Nothing is fitted.

    Args:
        runs: each is simulated from its measured start with its own commands. Of two models the better one shows on runs that
            neither was fitted to.
        model: the MJCF of all runs, or a fit, which acts with the effects that it found; default of each run its own, else the
            robot's.
        effects: a file of effects that act beside an MJCF, such as the `calibrated.effects.toml` that was written with it.
        robot: a robot's folder: its model where a run names none, with its effects.
        joints: of an MJCF, those to compare; default all that it controls by position and every run commands and measures. A
            fit is judged by the joints that were fitted.

    Raises:
        BadInput: no runs, no model, no joints in common, a run of a model that was not fitted, or a rule that refuses.
    """
    runs, said = with_rows(_listed(runs))
    if isinstance(model, Identification):
        if effects or robot or (joints is not None and set(joints) != set(model.joints)):
            raise BadInput(
                f"a fit is judged with its own effects by the joints that were fitted: {', '.join(model.joints)}",
                remedy="leave effects, robot and joints out, or judge what `report` wrote of it",
            )
        runs, path = _as_fitted(runs, model), model.models[0]
        common = joints_in_common(runs, path, model.joints)
        parameters, u = model.parameters, model.u
    else:
        runs, path, named = _modelled(runs, model, robot)
        said += named
        common = joints_in_common(runs, path, joints)
        parameters, u = (), np.zeros(0)
    plants = plants_of(runs, path, common)
    said += check_runs(runs, plants, fitting=False)
    runs = [without_errors(without_turns(run, common), common)[0] for run in runs]
    if isinstance(model, Identification):
        data = [dataset_of(model, run) for run in runs]
    else:
        entries, where = _beside(plants, effects, robot)
        both = (line for plant in plants for line in check_pair(entries, plant.model, plant.path, where))
        said += tuple(dict.fromkeys(both))
        acting = values_of(entries, common)
        data = [Dataset.prepare(plant, [run], acting=acting) for run, plant in zip(runs, plants, strict=True)]
    short = np.concatenate([one.simulate(parameters, [u], one.horizon).pos[0] for one in data])
    simulated = tuple(one.simulate(parameters, [u], one.full).pos[0] for one in data)
    full, measured = np.concatenate(simulated), np.concatenate([one.measured for one in data])
    return Judgement(
        model=path.name if parameters == () else f"{path.name}, calibrated",
        joints=tuple(common),
        runs=tuple(runs),
        gap=Gap(gap(measured, short), gap(measured, full)),
        floor=float(np.sqrt(np.mean(floors(runs, common)[0] ** 2))),
        doubt=disagreement(runs, common),
        simulated=simulated,
        by_joint={joint: gap(measured[:, j], full[:, j]) for j, joint in enumerate(common)},
        notes=said,
    )


def _modelled(
    runs: Sequence[Run], model: File | None, robot: File | None = None
) -> tuple[list[Run], Path, tuple[str, ...]]:
    """As `models_of`, of paths in either form."""
    folder = None if robot is None else partial(RobotFolder.at, Path(robot))
    return models_of(runs, None if model is None else Path(model), folder)


def _beside(
    plants: Sequence[Plant], file: File | None, robot: File | None
) -> tuple[tuple[EffectEntry, ...], Path | None]:
    """The effects that act, and where they stand: the file's, else the robot's where the model of all runs is the robot's own."""
    if file is not None:
        return read_effects(Path(file), plants[0].joints), Path(file)
    if robot is None:
        return (), None
    return RobotFolder.at(Path(robot)).effects_beside(plant.path for plant in plants)


def _as_fitted(runs: Sequence[Run], found: Identification) -> list[Run]:
    """Runs as runs of the models that were fitted: of the only one, or each of its own."""
    if len(found.models) == 1:
        return with_model(runs, found.models[0])[0]
    fitted = {path.resolve() for path in found.models}
    for run in runs:
        own = own_model(run)
        if own is None or own.resolve() not in fitted:
            raise BadInput(
                f"its model is {own.name if own else 'not named'}, and fitted were "
                + ", ".join(path.name for path in found.models),
                where=run.path or run.name,
                remedy="name in the run's facts which of them it is",
            )
    return list(runs)


def report(found: Identification, folder: File, *, robot: File | None = None) -> list[Path]:
    """Write what a fit found into a folder: `report.html`, which opens offline, `fit.json` and `calibrated.xml`.

    Of runs with several models there is a `calibrated-STEM.xml` for each. What is better with effects that MuJoCo has no feature
    for goes to `with-effects` in it.

    Args:
        found: what `fit` returned.
        folder: it is made where it is missing; an earlier fit in it is replaced.
        robot: a robot's folder, into which model and values go too, with where they came from.

    Returns:
        the files that were written.

    Raises:
        BadInput: the robot's folder is none.
        OSError: the disk takes no more.
    """
    written = write_fit(found, Path(folder))
    best = found.with_effects or found
    if robot is not None and best.accepted:
        place = RobotFolder.at(Path(robot))
        write_robot(best, place)
        written.append(place.config_file)
    return written


def summary(found: Identification) -> str:
    """What a fit found, for reading: each value with its 95 % interval, unit and verdict, the gap on held-out runs, the notes."""
    shown = {said(value.name): number(value.value, value.unit, value.low, value.high) for value in found.values}
    width, wide = (max(map(len, words)) for words in (shown.keys(), shown.values()))
    lines = [
        f"{name:{width}}  {words:{wide}}  {value.words}"
        for (name, words), value in zip(shown.items(), found.values, strict=True)
    ]
    judged = "runs left out in turn, each with all choices made anew" if found.in_turn else "held-out runs"
    lines.append(
        f"error on {judged}, full run: {_error(found.before.full)} → {_error(found.after.full)}; "
        f"{exact(HORIZON_S, 's')}: {_error(found.before.horizon)} → {_error(found.after.horizon)}; "
        f"floor {_error(found.floor)}"
    )
    return "\n".join([*lines, *found.notes])


def _error(rad: float) -> str:
    return number(rad, "rad", name="error")


def _listed(runs: Run | Sequence[Run]) -> list[Run]:
    listed = [runs] if isinstance(runs, Run | str | os.PathLike) else list(runs)
    for run in listed:
        if not isinstance(run, Run):
            raise BadInput(f"this is no run: {run!r}", remedy="read it first: sysid.load(…)")
    return listed
