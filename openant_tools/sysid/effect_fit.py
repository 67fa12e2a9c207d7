"""What a plain model leaves, tried with the effects that MuJoCo has no feature for.

A fit of what MuJoCo carries comes first, because its model plays anywhere. Where what it leaves is not noise, the same fit
is done once more with what geared servos are known to do beside it, and kept apart: only if it follows what is left out of the
fit better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from openant_tools.model.gap import Gap
from openant_tools.model.plant import Setup
from openant_tools.recording.run import Run
from openant_tools.robot.config import EffectEntry as Entry
from openant_tools.sysid.choice import pays, pooled
from openant_tools.sysid.dataset import sensor_floor
from openant_tools.sysid.declared import Declaration
from openant_tools.sysid.identify import Identification, identify
from openant_tools.sysid.kinds import ELECTRICAL_DAMPING, KINDS
from openant_tools.sysid.weights import WHITE

__all__ = ["TRIED", "better", "brakes_alike", "chosen_in_turn", "with_effects"]

Progress = Callable[[float, str], None]

#: the effects, as kinds of parameters: on real gears (docs/effects.md) no law of constant friction explains as much
TRIED = ("load_friction", "load_friction_at_rest")
#: residuals below this many deviations of the encoder's rounding are not worth a second fit
WORTH_LOOKING = 3.0


def _leaves_more_than_noise(result: Identification) -> bool:
    """Whether some joint's residual is the model's error: far above the encoder's step, and no white noise."""
    runs = [run for data in result.datasets for run in data.runs]
    period = float(np.median(np.concatenate([np.diff(run.t) for run in runs])))
    floor = sensor_floor(runs, result.joints)
    return any(
        result.correlation_s[joint] > WHITE * period and result.noise[joint] > WORTH_LOOKING * least
        for joint, least in zip(result.joints, floor, strict=True)
    )


def with_effects(
    plain: Identification,
    runs: Sequence[Run],
    hold_out: Sequence[Run] = (),
    *,
    also: Sequence[str] = (),
    tie: str = "joint",
    declared: Declaration | None = None,
    measured_supply: bool = False,
    effects: Sequence[Entry] = (),
    progress: Progress | None = None,
) -> Identification | None:
    """The fit with TRIED beside what `plain` fitted; None where nothing is left to try it for. Which of both wins, `better` says.

    Args:
        plain: what `identify` made of the same runs with the same arguments.
        runs, hold_out, also, tie, declared, effects, progress: as `identify` took them.
        measured_supply: as well; where it was not asked for, gains and torque limits follow what was logged if runs that are
            left out are followed better so. (A plain model has to do without: a simulation knows no voltage.)
    """
    acting = {name for name, _ in plain.effects}
    tried = [kind for kind in TRIED if kind not in also and (KINDS[kind].effect or ("",))[0] not in acting]
    if not tried or not _leaves_more_than_noise(plain):
        return None
    return identify(
        runs,
        plain.model,
        hold_out,
        joints=plain.joints,
        also=[*also, *tried],
        tie=tie,
        declared=declared,
        measured_supply=measured_supply or None,
        # A law that may trust the motions that it follows well chooses what it is judged by.
        tempered=True,
        effects=effects,
        checked=plain.checked,
        progress=progress,
    )


def better(richer: Identification, plain: Identification) -> bool:
    """Whether a fit with effects found some, their intervals clear of none, and folds do not show the plain one to be better.

    Gears are known to rub more under load, so that two or three motions left out are no jury that must be won over: they have a
    veto. Held-out runs have no say in it: they judge.
    """
    found = any(
        value.name.partition(".")[0] in TRIED and value.low is not None and value.low > 0 for value in richer.values
    )
    return found and not pays(plain.choice, richer.choice, surely=True)


def chosen_in_turn(richer: Identification, plain: Identification) -> Gap | None:
    """What the better of both leaves of runs left out in turn, where the folds have their say anew without each; None where none
    were."""
    best = [
        other if pays(other.chosen, one.chosen, surely=True) else one
        for one, other in zip(richer.turns, plain.turns, strict=True)
    ]
    return pooled([turn.after for turn in best], [turn.samples for turn in best]) if best else None


def brakes_alike(plain: Identification, richer: Identification) -> bool:
    """Whether the plain model shall lose its damping with the torque as the better one with effects does.

    No motion with torque on tells the plain model, so that it would fall as if the motor still braked it.
    """
    unknown = all(parameter.kind != ELECTRICAL_DAMPING for parameter in plain.parameters)
    goes = any(p.kind == ELECTRICAL_DAMPING and u > 0 for p, u in zip(richer.parameters, richer.u, strict=True))
    on_floor = any(data.plant.setup is Setup.FLOOR for data in plain.datasets)
    return unknown and goes and not on_floor and better(richer, plain)
