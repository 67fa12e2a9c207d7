"""The diagnosis of whatever was recorded: where the gap lies, which causes explain it, and how far that closes it on held-out data.

In this order, a module each: `experiment` (the windows that tell most), `assess` (what each cause would do to them, and what the evidence
comes to), `trials` (what the likeliest close on folds that their fits have not seen), `decide`, `finding` (what is handed on).
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from threadpoolctl import threadpool_limits

from openant_tools.effects.catalogue import catalogue
from openant_tools.errors import BadInput
from openant_tools.files import json_text, write_text
from openant_tools.gap.assess import Assessment, assess
from openant_tools.gap.cache import cache_folder, code, keep_small
from openant_tools.gap.decide import PRESENT, Row, decide, led, present, weights, worth_fitting
from openant_tools.gap.diagnosis import UNEXPLAINED, Diagnosis, read_diagnosis
from openant_tools.gap.experiment import Experiment
from openant_tools.gap.finding import Given, Tried, finding
from openant_tools.gap.trials import Trials
from openant_tools.numbers import number
from openant_tools.recording.run import Run
from openant_tools.sysid.identify import joints_in_common

__all__ = ["content", "diagnose", "hypotheses", "prepare"]

Progress = Callable[[float, str], None]

#: causes whose first steps are looked at, those that the recording goes along farthest, and that are fitted then: by themselves, and beside
#: what is chosen
TRIED, SUSPECTS = 15, 5
SECONDS, FURTHER = 6, 2
#: causes of one improved model
CAUSES = 3
#: what a builder's word is worth who expects a cause: odds, to one
EXPECTED = 10.0


@contextlib.contextmanager
def _alike_everywhere() -> Iterator[None]:
    """Matrices are multiplied by one thread: the sums of several are rounded otherwise than those of another number of cores."""
    with threadpool_limits(1, "blas"):
        yield


@_alike_everywhere()
def diagnose(
    runs: Sequence[Run],
    model: Path,
    *,
    hold_out: Sequence[Run] = (),
    joints: Sequence[str] | None = None,
    prior: Sequence[str] = (),
    recall: bool = False,
    progress: Progress | None = None,
) -> Diagnosis:
    """Diagnose the gap between a robot and its model.

    Args:
        runs: recordings of one robot. hold_out: recordings to judge on; without them parts of the runs are left out in turn.
        joints: default every position servo of the model that all runs command and measure.
        prior: effects that are known or expected of this robot: where the runs cannot tell causes apart, they do.
        recall: whether to answer as before, where this code was asked the same before, and to keep the answer for that.
        progress: told a share and words.

    Raises:
        BadInput: no such effect, or runs from which no diagnosis can be made.
    """
    tell = progress or (lambda share, words: None)
    _check(runs, hold_out)
    _check_prior(prior)
    wanted = joints_in_common([*runs, *hold_out], model, joints)
    _check_motion([*runs, *hold_out], wanted)
    # In whatever order runs are named, the same robots are simulated for them.
    experiment = Experiment.of(sorted(runs, key=content), model, wanted, sorted(hold_out, key=content))
    tell(0.02, str(experiment.selection))
    if recall:
        place = cache_folder() / f"diagnosis-{_asked(experiment, model, runs, hold_out, prior)}.json"
        with contextlib.suppress(BadInput):  # not there, cut or another's: it is made anew
            found = read_diagnosis(place)
            place.touch()  # used now
            return found
    trials, rows = hypotheses(experiment, prior, lambda share, words: tell(0.02 + 0.73 * share, words))
    decision = decide(rows, trials.anomaly)
    # Others are looked for also beside a cause than which something unknown is likelier so far, or another cause as likely.
    chosen = (decision.likeliest,) if decision.verdict == UNEXPLAINED else decision.causes
    declined, there = list[Row](), dict[str, float]()
    if chosen not in trials.closures:  # named by the evidence alone: held-out data do not tell of it
        trials.fit([(), chosen])
    while chosen in trials.closures and 0 < len(chosen) < CAUSES:
        tell(0.8 + 0.05 * len(chosen), f"what acts beside {' and '.join(chosen)}")
        further = _further(trials, chosen, [name for group in decision.alike for name in group])
        trials.fit([chosen, *further])
        asked = [trials.row(causes) for causes in further]
        there |= (said := present(asked, trials.closures[chosen].uneven, weights()))
        likely = [row for row in asked if said.get(row.causes[-1], 0.0) > PRESENT]
        more = max(likely, key=lambda row: said[row.causes[-1]], default=None)
        declined += [row for row in asked if row is not more]
        if more is None:
            break
        chosen = more.causes
        rows.append(more)
    # What several causes explain together is not unexplained, and those that are both there are no alternatives.
    decision = decide(rows, trials.anomaly)
    if not set(decision.causes) & set(chosen):
        chosen = decision.causes
    tell(1.0, "decision")
    given = Given(model, tuple(runs), tuple(hold_out), tuple(prior))
    found = finding(trials, given, Tried(rows, declined, there), decision, chosen)
    if recall:
        with contextlib.suppress(OSError):  # a full disk takes nobody's answer away
            write_text(place, json_text(found.as_json()))
            keep_small(place)
    return found


def hypotheses(experiment: Experiment, prior: Sequence[str], progress: Progress) -> tuple[Trials, list[Row]]:
    """What is decided on: no cause, and each by itself, the likeliest of them fitted."""
    assessment = assess(experiment.protocol, lambda share, words: progress(0.8 * share, words))
    trials, fit = Trials.of(experiment, assessment), assessment.fit
    leading = {name for name in fit if _leads(assessment, name)}
    # By itself first: causes begin where tolerances have come to, with what was learnt of them, and so does none.
    trials.fit([()])
    progress(0.82, "where the likeliest causes lead")
    ranked = sorted((name for name in leading if trials.tells(name)), key=lambda name: (-fit[name], name))
    worth = worth_fitting(fit, trials.promise([(name,) for name in ranked[:TRIED]]))
    suspects = worth[:SUSPECTS] + [name for name in prior if name in fit and name not in worth[:SUSPECTS]]
    progress(0.86, "what those worth it close on held-out parts")
    trials.fit([(), *((name,) for name in suspects)])
    word = dict.fromkeys(prior, math.log(EXPECTED))
    rows = [
        replace(trials.row((name,)), leads=name in leading, told=catalogue()[name].told, expected=word.get(name, 0.0))
        for name in sorted(fit, key=lambda name: (-fit[name], name))
    ]
    return trials, [trials.none(), *led(rows)]


@_alike_everywhere()
def prepare(
    runs: Sequence[Run], model: Path, joints: Sequence[str] | None = None, progress: Progress | None = None
) -> int:
    """Simulate what a diagnosis of these runs will be judged by, so that it takes less; no verdict depends on it.

    Returns:
        how many robots.
    """
    experiment = Experiment.of(sorted(runs, key=content), model, joints_in_common(runs, model, joints))
    return assess(experiment.protocol, progress or (lambda share, words: None)).robots


def _further(trials: Trials, chosen: tuple[str, ...], alike: Sequence[str]) -> list[tuple[str, ...]]:
    """What is chosen with one cause more: those that fit what it leaves, whose first steps promise most, and then one of random times.

    Args:
        alike: causes that are tried in any case: as likely as what is chosen, they may both be there.
    """
    found = trials.further(chosen)
    told = [causes for causes in found if trials.tells(causes[-1])][:SECONDS]
    left = {causes[-1]: trials.along[causes] for causes in told}
    worth = worth_fitting(left, trials.promise(told, chosen))
    random = [] if any(catalogue()[name].random for name in chosen) else [c for c in found if catalogue()[c[-1]].random]
    also = [name for name in alike if name not in chosen and trials.tells(name)]
    return [*((*chosen, name) for name in dict.fromkeys([*also, *worth[:FURTHER]])), *random]


def _leads(assessment: Assessment, name: str) -> bool:
    """Whether a cause may lead: a gap is led by where it is largest, and a sensor that is off is none of a motion that is."""
    moves = assessment.anomalies.get("pos", 0.0)
    elsewhere = max((size for signal, size in assessment.anomalies.items() if signal != "pos"), default=0.0)
    return elsewhere >= moves or not catalogue()[name].of_sensors_at(assessment.template(name))


def _check(runs: Sequence[Run], hold_out: Sequence[Run]) -> None:
    if not runs:
        raise BadInput("only held-out runs", remedy="name runs to diagnose beside --hold-out")
    for one in hold_out:
        for other in runs:
            if content(one) == content(other):
                raise BadInput(
                    f"the held-out run is the same as {other.name}", where=one.path or one.name,
                    remedy="hold out a run that is not diagnosed",
                )  # fmt: skip


def _check_prior(prior: Sequence[str]) -> None:
    for name in prior:
        if name not in catalogue():
            near = difflib.get_close_matches(name, catalogue(), 1)
            raise BadInput(
                f"there is no effect {name!r}",
                remedy=f"did you mean {near[0]!r}?" if near else f"name one of: {', '.join(sorted(catalogue()))}",
            )


def _asked(
    experiment: Experiment, model: Path, runs: Sequence[Run], hold_out: Sequence[Run], prior: Sequence[str]
) -> str:
    """What a diagnosis follows from: the code, models as they are compiled, joints, all that runs hold, and what is expected."""
    state = hashlib.sha256(f"{code()} {model} {experiment.parts.joints} {list(prior)}".encode())  # for a file
    for part in experiment.parts.runs:
        compiled = np.empty(mujoco.mj_sizeModel(part.plant.model), np.uint8)
        mujoco.mj_saveModel(part.plant.model, None, compiled)
        state.update(compiled.tobytes())
    for words, some in (("runs", runs), ("held out", hold_out)):
        for run in some:
            state.update(f"{words} {run.name} {run.path} {run.facts}".encode())
            for name, values in [("t", run.t), *sorted(run.columns.items())]:
                plain = values if values.dtype.kind in "fiub" else values.astype(str)
                state.update(f"{name} {plain.dtype} {plain.shape}".encode())
                state.update(np.ascontiguousarray(plain).tobytes())
    return state.hexdigest()[:24]


def content(run: Run) -> str:
    """What a run is told by, and sorted by: of its times, commands and positions."""
    state = hashlib.sha256(np.ascontiguousarray(run.t).tobytes())
    for name in sorted(run.columns):
        if name.startswith(("pos.", "cmd.")):
            state.update(np.ascontiguousarray(run.columns[name]).tobytes())
    return state.hexdigest()


def _check_motion(runs: Sequence[Run], joints: Sequence[str]) -> None:
    moved = 0.0
    for run in runs:
        pos = run.signal("pos", joints)
        moved = max(moved, float(np.nanmax(np.nanmax(pos, axis=0) - np.nanmin(pos, axis=0))))
    if moved < math.radians(1):
        raise BadInput(
            f"nothing moves: no joint goes farther than {number(moved, 'rad')}", where=runs[0].path or runs[0].name,
            remedy="record a protocol that moves the joints, see `openant sysid record --list`; angles are in rad",
        )  # fmt: skip
