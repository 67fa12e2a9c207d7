"""Does a simulation rank policies as the robot does? The gap that matters to someone who picks a policy by simulation.

With S_i the average reward of policy i in a simulation and R_i on the robot:

- Spearman's ρ (Pearson's r of the ranks) and Kendall's τ, with intervals by bootstrap over policies, in which every reward
  is also drawn anew within its own standard error;
- mean maximum rank violation, (1/N) Σ_i max_j |R_i − R_j| · [(S_i > S_j) ≠ (R_i > R_j)] (SIMPLER, arXiv 2405.05941), in m/s,
  0 at best;
- regret of choosing the simulated best, max R − R[argmax S], in m/s and as a share of max R.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from openant_agents.evaluate import LIKELIEST, SAMPLED, Plays, evaluate
from openant_agents.exploits import DISTURBANCES, Flag, TwitchCounter, flag
from openant_agents.places import Place
from openant_agents.policies import load_policy
from openant_agents.runs import read_facts
from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, write_text
from openant_tools.procedure.intervals import Interval
from openant_tools.procedure.relay import part_of

__all__ = [
    "Agreement", "PlaceResult", "Ranking", "agreement", "check_names", "find_policies", "kendall", "play", "play_disturbed", "rank",
    "rank_violation",
    "read_measured", "regret", "spearman", "write_measured",
]  # fmt: skip

SCHEMA = "openant.policies/1"
RESAMPLES = 2_000
#: times fewer starts where a simulation is disturbed: what falls apart there is seen in a few
FEWER = 5
#: what the robot is called among the places of a ranking's file
ROBOT = "real"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaceResult:
    """What a policy achieved in one place, with actions drawn as in training (`evaluate.SAMPLED`), by which it is ranked.

    Attributes:
        average_reward_m_s: m/s, mean over plays.
        standard_error_m_s: m/s, of that mean.
        plays: m/s, each.
        reversals_hz: how often the actions of a joint turned back, per second: walking does so once or twice.
        helped: how often the robot had to be set up again.
        likeliest: its likeliest action beside it: `median`, `low` and `high` in m/s, and `stood_still`, how many plays
            ended so; None where it was not played.
    """

    average_reward_m_s: float
    standard_error_m_s: float
    plays: tuple[float, ...]
    reversals_hz: float
    helped: int
    likeliest: Mapping[str, float] | None = None

    @classmethod
    def of(
        cls,
        plays: Sequence[float],
        reversals_hz: float = math.nan,
        helped: int = 0,
        likeliest: Mapping[str, float] | None = None,
    ) -> PlaceResult:
        n = len(plays)
        error = float(np.std(plays, ddof=1) / math.sqrt(n)) if n > 1 else 0.0
        return cls(float(np.mean(plays)), error, tuple(plays), reversals_hz, helped, likeliest)

    @property
    def median(self) -> float:
        """m/s, over plays."""
        return float(np.median(self.plays))


@dataclass(frozen=True)
class Agreement:
    """How well the rewards of a simulation foretell those of the robot.

    Attributes:
        policies: N.
        spearman, kendall: ρ and τ.
        rank_violation_m_s: mean maximum rank violation.
        regret_m_s, regret_share: of choosing the simulated best.
        best_is: place on the robot of the policy that is best in the simulation, 1 for the best.
    """

    policies: int
    spearman: Interval
    kendall: Interval
    rank_violation_m_s: Interval
    regret_m_s: Interval
    regret_share: float
    best_is: int

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


# ---------------------------------------------------------------------------------------------------------- figures


def spearman(a: Array, b: Array) -> float:
    """ρ, Pearson's r of the ranks, ties ranked by their mean; NaN where one of them is all alike."""
    a, b = rankdata(a), rankdata(b)
    a, b = a - a.mean(), b - b.mean()
    spread = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / spread if spread > 0.0 else math.nan


def kendall(a: Array, b: Array) -> float:
    """τ_b: concordant minus discordant pairs over the geometric mean of the pairs that are not tied in either."""
    before, after = np.sign(np.subtract.outer(a, a)), np.sign(np.subtract.outer(b, b))
    pairs = math.sqrt(float(np.count_nonzero(before)) * float(np.count_nonzero(after)))
    return float((before * after).sum()) / pairs if pairs > 0.0 else math.nan


def rank_violation(simulated: Array, real: Array) -> float:
    """Mean maximum rank violation, in the unit of `real`; both (policies,)."""
    wrong = np.greater.outer(simulated, simulated) != np.greater.outer(real, real)
    return float((np.abs(np.subtract.outer(real, real)) * wrong).max(axis=1).mean())


def regret(simulated: Array, real: Array) -> float:
    """What the simulated best falls short of the real best, in the unit of `real`; both (policies,)."""
    return float(real.max() - real[int(np.argmax(simulated))])


def agreement(simulated: Sequence[PlaceResult], real: Sequence[PlaceResult], *, seed: int = 0) -> Agreement:
    """Compare the rewards of the same policies in a simulation and on the robot.

    Raises:
        BadInput: fewer than three policies: ranks of two agree or do not.
    """
    n = len(simulated)
    if n < 3 or n != len(real):
        raise BadInput(f"{n} policies cannot be ranked", remedy="rank three or more, trained for different times")
    s, r = (np.array([one.average_reward_m_s for one in which]) for which in (simulated, real))
    se, re = (np.array([one.standard_error_m_s for one in which]) for which in (simulated, real))

    figures: dict[str, Callable[[Array, Array], float]] = {
        "spearman": spearman,
        "kendall": kendall,
        "rank_violation_m_s": rank_violation,
        "regret_m_s": regret,
    }
    random = np.random.default_rng(seed)
    drawn: dict[str, list[float]] = {name: [] for name in figures}
    for _ in range(RESAMPLES):
        chosen = random.integers(0, n, n)
        if len(np.unique(chosen)) < 3:
            continue
        a = random.normal(s[chosen], se[chosen])
        b = random.normal(r[chosen], re[chosen])
        for name, figure in figures.items():
            drawn[name].append(figure(a, b))
    spans = {}
    for name, figure in figures.items():
        sound = np.array([value for value in drawn[name] if math.isfinite(value)])
        low, high = np.percentile(sound, [2.5, 97.5]) if len(sound) else (math.nan, math.nan)
        spans[name] = Interval(figure(s, r), float(low), float(high))
    best = float(r.max())
    return Agreement(
        policies=n,
        **spans,
        regret_share=spans["regret_m_s"].value / best if best > 0.0 else math.nan,
        best_is=1 + int((r > r[int(np.argmax(s))]).sum()),
    )


@dataclass(frozen=True)
class Ranking:
    """Policies on the robot and in simulations of it.

    Attributes:
        real: by policy. simulated: by simulation and policy, of the same policies.
        agreements: by simulation. flags: policies that perhaps exploit the simulation that they would be chosen by.
    """

    real: Mapping[str, PlaceResult]
    simulated: Mapping[str, Mapping[str, PlaceResult]]
    agreements: Mapping[str, Agreement]
    flags: tuple[Flag, ...] = ()

    def flagged(self, chooser: str, worse: Mapping[str, Mapping[str, PlaceResult]]) -> Ranking:
        """The same with flags.

        Args:
            chooser: the simulation that one would choose by.
            worse: what policies achieve where it is disturbed, by disturbance.
        """
        others = {f"the {name} simulation": one for name, one in self.simulated.items() if name != chooser}
        flags = []
        for policy, here in self.simulated[chooser].items():
            otherwise = {words: one[policy].average_reward_m_s for words, one in {**worse, **others}.items()}
            flags.append(flag(policy, here.average_reward_m_s, otherwise, here.reversals_hz))
        return replace(self, flags=tuple(one for one in flags if one is not None))

    def as_dict(self) -> dict[str, Any]:
        """As it stands in files."""
        rewards = {ROBOT: self.real, **self.simulated}
        return {
            "schema": "openant.ranking/1",
            "policies": {
                policy: {f"{place}_m_s": measured[policy].average_reward_m_s for place, measured in rewards.items()}
                for policy in self.real
            },
            "agreement": {name: one.as_dict() for name, one in self.agreements.items()},
            "flags": [
                {"policy": one.policy, "keeps": dict(one.depends_on), "reversals_hz": one.reversals_hz} for one in self.flags
            ],
        }  # fmt: skip


def check_names(simulations: Iterable[str]) -> None:
    """Raise BadInput where a simulation has the robot's name."""
    if ROBOT in simulations:
        raise BadInput(f"a simulation is called {ROBOT}, which is the robot", remedy="give it another name")


def rank(real: Mapping[str, PlaceResult], simulated: Mapping[str, Mapping[str, PlaceResult]]) -> Ranking:
    """Say which simulation ranks policies as the robot does.

    Args:
        real: what was measured on the robot, by policy. simulated: in simulations of it, of these policies and perhaps others.

    Raises:
        BadInput: a simulation lacks a policy or is called `real`, or there are fewer than three policies.
    """
    check_names(simulated)
    for name, measured in simulated.items():
        for policy in real:
            if policy not in measured:
                raise BadInput(
                    f"{name} has no reward of {policy}", remedy="play it there, or leave it out of --policies"
                )
    same = {name: {policy: measured[policy] for policy in real} for name, measured in simulated.items()}
    return Ranking(
        real, same, {name: agreement([*measured.values()], [*real.values()]) for name, measured in same.items()}
    )


# ---------------------------------------------------------------------------------------------------------- playing


def find_policies(folder: Path) -> dict[str, Path]:
    """The training runs in a folder by name, in order.

    Raises:
        BadInput: there is none.
    """
    runs = {path.parent.name: path.parent for path in sorted(folder.glob("*/run.json"))} if folder.is_dir() else {}
    if not runs:
        raise BadInput(
            "there are no policies here", where=folder, remedy="name a folder with the --out folders of `openant train`"
        )
    return runs


def play(
    runs: Mapping[str, Path], place: Place, *, seconds: float, starts: int | None = None, likeliest: bool = False,
    wrapper: Callable[[Any], Any] = lambda env: env,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> Iterator[tuple[str, PlaceResult]]:  # fmt: skip
    """Play each policy in one place: its name and what it achieved, as soon as that is known.

    Args:
        runs: name → training run. seconds: s of robot time from each start.
        starts: how many, with other headings each; None for as many as the place asks for.
        likeliest: whether the likeliest action is played beside it. wrapper: disturbs the place.

    Raises:
        BadInput: no such policy, or one that does not fit the place.
    """
    ways, starts = (SAMPLED, LIKELIEST) if likeliest else (SAMPLED,), starts or place.starts
    for number, (name, run) in enumerate(runs.items()):
        env = TwitchCounter(wrapper(place.make(read_facts(run)["env"])))
        try:
            policy = load_policy(run, env)
            done, reversals_hz = list[Plays](), math.nan
            for way in ways:
                words = f"{place.name}: {name} ({number + 1} of {len(runs)}), "
                tell = part_of(progress, number * len(ways) + len(done), len(runs) * len(ways), words)
                done.append(evaluate(env, policy, way=way, seconds=seconds, starts=starts, progress=tell))
                if way == SAMPLED:
                    reversals_hz = env.reversals_hz
        finally:
            env.close()
        rewards, helped = done[0].rewards.tolist(), done[0].helped.total()
        yield name, PlaceResult.of(rewards, reversals_hz, helped, done[1].as_dict() if likeliest else None)


def play_disturbed(
    runs: Mapping[str, Path], place: Place, *, seconds: float, starts: int | None,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> dict[str, dict[str, PlaceResult]]:  # fmt: skip
    """What each policy achieves where a simulation is disturbed, by disturbance, from a fifth of the starts; as `play`."""
    few = max(1, (starts or place.starts) // FEWER)
    return {
        words: dict(play(runs, place, seconds=seconds, starts=few, wrapper=wrapper, progress=progress))
        for words, wrapper in DISTURBANCES.items()
    }


# ------------------------------------------------------------------------------------------------------------- files


def write_measured(file: Path, measured: Mapping[str, PlaceResult], **facts: Any) -> None:
    """Write what policies achieved in one place, with whatever says where that was."""
    policies = {name: asdict(one) for name, one in measured.items()}
    write_text(file, json_text({"schema": SCHEMA, **facts, "policies": policies}))


def read_measured(file: Path) -> dict[str, PlaceResult]:
    """What `write_measured` wrote, or rewards by name from elsewhere.

    Raises:
        BadInput: the file says something else.
    """
    try:
        policies = read_json(file, "name what `openant policies play` wrote")["policies"]
        found = {}
        for name, one in policies.items():
            one = {"average_reward_m_s": one} if isinstance(one, int | float) else one
            one = {key: said for key, said in one.items() if said is not None}  # a number that is not known
            value = float(one["average_reward_m_s"])
            found[name] = PlaceResult(
                value, float(one.get("standard_error_m_s", 0.0)), tuple(one.get("plays", (value,))),
                float(one.get("reversals_hz", math.nan)), int(one.get("helped", 0)), _likeliest(one.get("likeliest")),
            )  # fmt: skip
    except OSError as error:
        raise BadInput("it cannot be read", where=file, remedy="name what `openant policies play` wrote") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(
            "it does not say what policies achieved", where=file, remedy="name what `openant policies play` wrote"
        ) from error
    if not all(math.isfinite(one.average_reward_m_s) for one in found.values()):
        raise BadInput("a reward in it is no number", where=file, remedy="measure that policy again")
    return found


def _likeliest(said: Any) -> dict[str, float] | None:
    return None if said is None else {str(key): float(value) for key, value in dict(said).items()}
