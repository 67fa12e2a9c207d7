"""Searching settings of an agent with Optuna, in the spaces that the paper searched.

A trial trains on some seeds and is worth the average reward per second over the whole of that time, as in the paper: an
agent that learns early is worth more than one that learns late. Everything a search knows is in Optuna's storage, so
that any number of processes and machines work on one study, and each may stop or be killed at any time: what a killed
process was trying is tried again by another.
"""

from __future__ import annotations

import json
import random
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import optuna
import sqlalchemy
from optuna.storages.journal import JournalFileBackend

from openant_agents import sac, sarsa
from openant_agents.training import TrainingProgress
from openant_tools.errors import BadInput
from openant_tools.files import reading

__all__ = ["SPACES", "Agent", "best_settings", "open_study", "search"]

Agent = str

#: s between signs of life of a process that tries something, and without one until another tries it again
HEARTBEAT_S, GIVEN_UP_S = 60, 240
#: how often a trial is tried again whose process was killed
RETRIES = 3
#: Processes that begin a study together make its tables together, and all but one of them fail: they look again, so often.
OPENINGS = 6
RACES = (sqlalchemy.exc.OperationalError, sqlalchemy.exc.IntegrityError, sqlalchemy.exc.ProgrammingError)


def _sarsa(trial: optuna.Trial) -> sarsa.SarsaSettings:
    """The paper's space of SARSA(λ); the step size is a base shared by all tilings."""
    tilings = 24 * trial.suggest_int("tilings_by_24", 2, 8)
    return sarsa.SarsaSettings(
        epsilon=trial.suggest_float("epsilon", 0.01, 0.3, log=True),
        gamma=trial.suggest_float("gamma", 0.9, 0.999),
        trace=trial.suggest_float("trace", 0.0, 0.99),
        tiles=trial.suggest_int("tiles", 4, 16),
        tilings=tilings,
        step_size=trial.suggest_float("step_size_base", 0.01, 0.5, log=True) / tilings,
        reward_scale=trial.suggest_float("reward_scale", 1.0, 10.0, log=True),
    )


def _sac(trial: optuna.Trial) -> sac.SacSettings:
    """The paper's grid of SAC in simulation; its γ is taken as that of a second, as in the platform's software."""
    chosen = sac.SacSettings(
        gamma_per_s=trial.suggest_categorical("gamma_per_s", [0.98, 0.92]),
        tau=trial.suggest_categorical("tau", [0.005, 0.008]),
        batch=128,
        actor_step=trial.suggest_categorical("actor_step", [3e-3, 1e-3, 3e-4, 1e-4]),
        critic_step=trial.suggest_categorical("critic_step", [3e-3, 1e-3, 1e-4]),
        policy_every=trial.suggest_categorical("policy_every", [1, 2]),
    )
    if trial.suggest_categorical("autotune", [True, False]):
        return chosen
    # A weight that is not learned stays what it was.
    return replace(chosen, entropy_start=0.2, entropy_step=0.0)


#: agent → settings drawn by a trial
SPACES: Mapping[Agent, Callable[[optuna.Trial], sac.SacSettings | sarsa.SarsaSettings]] = {"sac": _sac, "sarsa": _sarsa}


class _Sum(gymnasium.Wrapper):  # type: ignore[misc]
    """Adds up rewards and robot time."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.reward = self.seconds = 0.0

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.reward += float(result[1])
        self.seconds += float(result[4]["dt"])
        return result


#: a file that machines append to; a path below the working directory, as of sqlite
JOURNAL = "journal:///"


def _storage(url: str) -> Any:
    if url.startswith("redis"):
        raise BadInput(
            "Optuna keeps no studies in Redis any more",
            where=url,
            remedy="use postgresql://…, sqlite:///tune.db, or journal:///tune.log on a disk that all machines see",
        )
    if url.startswith(JOURNAL):
        return optuna.storages.JournalStorage(JournalFileBackend(url.removeprefix(JOURNAL)))
    with warnings.catch_warnings():
        # Signs of life have been called experimental since 2021.
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.storages.RDBStorage(
            url,
            heartbeat_interval=HEARTBEAT_S,
            grace_period=GIVEN_UP_S,
            heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(max_retry=RETRIES),
        )


def open_study(url: str, name: str, facts: Mapping[str, Any]) -> optuna.Study:
    """A study in a storage, begun or gone on with.

    Args:
        url: `sqlite:///tune.db`, `postgresql://…` or another database of SQLAlchemy's, or `journal:///tune.log`, a file.
        name: of the study.
        facts: agent, seeds, steps and environment: a study goes on only if they are the same.

    Raises:
        BadInput: the storage cannot be opened, or the study is another.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    for attempt in range(OPENINGS):
        try:
            study = optuna.create_study(
                storage=_storage(url), study_name=name, direction="maximize", load_if_exists=True
            )
            break
        except BadInput:
            raise
        except Exception as error:  # of SQLAlchemy and its drivers: a dozen kinds without a common parent
            if attempt + 1 < OPENINGS and any(isinstance(one, RACES) for one in (error, error.__cause__)):
                time.sleep(random.uniform(0.1, 0.5))
                continue
            reason = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
            raise BadInput(
                f"the storage cannot be opened: {reason}", where=url, remedy="give a URL such as sqlite:///tune.db"
            ) from error
    asked = json.loads(json.dumps(facts))
    with reading(url, "the storage is not as Optuna wrote it", "name another, or mend it"):
        there = study.user_attrs.get("openant")
    if there is None:
        study.set_user_attr("openant", asked)
    elif not isinstance(there, dict):
        raise BadInput(f"the study {name} is none of ours", where=url, remedy="name another --study")
    elif there != asked:
        differing = sorted(key for key in there.keys() | asked.keys() if there.get(key) != asked.get(key))
        raise BadInput(
            f"the study {name} searches something else: it differs in {', '.join(differing)}",
            where=url,
            remedy="name another --study, or repeat the options that began it",
        )
    return study


def search(
    study: optuna.Study,
    agent: Agent,
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    *,
    trials: int,
    steps: int,
    seeds: Sequence[int],
    report: Callable[[int, int, TrainingProgress], None] | None = None,
    done: Callable[[optuna.Study, optuna.trial.FrozenTrial], None] | None = None,
) -> None:
    """Try settings until the study has so many trials, those of other processes included.

    Args:
        study: of `open_study`.
        agent: a key of `SPACES`.
        make_env: makes the environment of one seed.
        trials: how many the study is to have.
        steps: environment steps of each seed.
        seeds: that each trial trains on, one after the other.
        report: called a few times a second with the trial, the seed and how far it is.
        done: called after each trial.

    Raises:
        KeyboardInterrupt: what was being tried counts as failed; the study goes on with the same call.
    """

    def objective(trial: optuna.Trial) -> float:
        settings = SPACES[agent](trial)
        trial.set_user_attr("settings", asdict(settings))
        averages: list[float] = []
        for seed in seeds:
            env = _Sum(make_env())
            try:
                with tempfile.TemporaryDirectory(prefix="openant-tune-") as folder:
                    _train(agent, env, Path(folder), steps, seed, settings, partial(_tell, trial, seed))
            except BadInput as error:
                # Values that grow without bound are an answer, too.
                trial.set_user_attr("failed", str(error))
                raise optuna.TrialPruned(str(error)) from None
            finally:
                env.close()
            averages.append(env.reward / env.seconds)
            trial.set_user_attr("average_reward_m_s", averages)
        return sum(averages) / len(averages)

    def _tell(trial: optuna.Trial, seed: int, progress: TrainingProgress) -> None:
        if report is not None:
            report(trial.number, seed, progress)

    over = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED)
    if len(study.get_trials(deepcopy=False, states=over)) >= trials:
        return
    enough = optuna.study.MaxTrialsCallback(trials, states=over)
    study.optimize(objective, callbacks=[enough, *([done] if done is not None else [])])


def _train(
    agent: Agent,
    env: gymnasium.Env[Any, Any],
    folder: Path,
    steps: int,
    seed: int,
    settings: Any,
    report: Callable[[TrainingProgress], None],
) -> None:
    if agent == "sac":
        sac.train(env, folder=folder, steps=steps, seed=seed, settings=settings, report=report)
    else:
        sarsa.train(env, folder=folder, steps=steps, seed=seed, settings=settings, report=report)


def best_settings(study: optuna.Study) -> tuple[dict[str, Any], float]:
    """The settings of the best trial so far, as the agent takes them, and what they are worth (m/s).

    Raises:
        BadInput: no trial is complete yet.
    """
    with reading(study.study_name, "the storage is not as Optuna wrote it", "name another, or mend it"):
        try:
            best = study.best_trial
        except ValueError:
            raise BadInput("no trial is complete yet", where=study.study_name, remedy="let it search longer") from None
    with reading(study.study_name, "its best trial is not as `openant tune` wrote it", "name another --study"):
        return dict(best.user_attrs["settings"]), float(best.value or 0.0)
