"""What is learned at one joint holds at all of them."""

from __future__ import annotations

import numpy as np
import pytest

from openant_tools.gap.by_joint import ByJoint, places_of

JOINTS, EACH, CAUSES = 4, 6, ("late", "rough")


@pytest.fixture(scope="module")
def taught() -> tuple[ByJoint, np.ndarray, np.ndarray, np.ndarray]:
    """A judge of joints that has only ever seen "late" at the first two joints; what it was told; what robots have."""
    rng = np.random.default_rng(3)
    bank = [(cause, (j,), {}) for cause in CAUSES for j in range(JOINTS)]
    templates = np.zeros((len(bank), JOINTS * EACH), np.float32)
    for k, (cause, (j,), _) in enumerate(bank):
        templates[k, EACH * j + CAUSES.index(cause) * 3 :][:3] = 1
    mine = [np.arange(JOINTS * EACH) // EACH == j for j in range(JOINTS)]
    empty = ByJoint(
        CAUSES, (np.arange(JOINTS),), tuple((own,) for own in mine), tuple(places_of(bank, CAUSES, j) for j in range(JOINTS)),
        templates, tuple(np.arange(JOINTS) == j for j in range(JOINTS)),
    )  # fmt: skip
    z, logs = rng.normal(size=(240, JOINTS * EACH)).astype(np.float32), np.zeros((240, JOINTS), np.float32)
    robots: list[dict[str, tuple[tuple[int, ...], object]]] = []
    for row in range(len(z)):
        robots.append({})
        if row % 3:
            cause, joint = CAUSES[row % 3 - 1], int(rng.integers(2 if row % 3 == 1 else JOINTS))
            z[row] += 3 * templates[bank.index((cause, (joint,), {}))]
            robots[-1][cause] = ((joint,), None)
    found, unseen = empty.taught(z, logs, robots, 0)
    return found, unseen, z, np.array([CAUSES.index(next(iter(mine))) if mine else -1 for mine in robots])


def test_robots_that_were_not_taught_are_told_apart(taught: tuple[ByJoint, np.ndarray, np.ndarray, np.ndarray]) -> None:
    judge, logits, _, truth = taught
    unseen = judge.summary(logits)
    surest = unseen[:, len(CAUSES) : 2 * len(CAUSES)]
    for k in range(len(CAUSES)):
        assert np.quantile(surest[truth == k, k], 0.1) > np.quantile(surest[truth != k, k], 0.9)


def test_a_cause_is_known_at_a_joint_where_it_never_was(
    taught: tuple[ByJoint, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    judge, _, _, _ = taught
    z = np.random.default_rng(4).normal(size=(20, JOINTS * EACH)).astype(np.float32)
    logs = np.zeros((20, JOINTS), np.float32)
    healthy = judge.summary(judge.logits(z, logs))
    z[:, 3 * EACH : 3 * EACH + 3] += 3
    ill = judge.summary(judge.logits(z, logs))
    more = ill[:, len(CAUSES)] - healthy[:, len(CAUSES)]
    assert more.min() > 0
    assert more.mean() > 1.5


def test_templates_of_a_cause_at_a_joint_are_those_that_sit_there_alone_if_any_do() -> None:
    bank = [("late", (0,), {}), ("late", (0, 1), {}), ("heavy", (0, 1), {}), ("late", (1,), {})]
    assert [list(some) for some in places_of(bank, ["late", "heavy", "weak"], 1)] == [[3], [2], []]


def test_what_is_random_sits_where_joints_say_so(taught: tuple[ByJoint, np.ndarray, np.ndarray, np.ndarray]) -> None:
    judge, _, _, _ = taught
    everywhere, single = tuple(range(JOINTS)), [(j,) for j in range(JOINTS)]
    logits = np.full((JOINTS, len(CAUSES)), -4.0)
    logits[2, 1] = 3.0
    likely = judge.likelihood(logits, "rough", [*single, everywhere])
    assert int(likely.argmax()) == 2
    logits[:, 1] = 1.0
    likely = judge.likelihood(logits, "rough", [*single, everywhere])
    assert int(likely.argmax()) == len(single)
    assert np.exp(likely[-1]) == pytest.approx((1 / (1 + np.exp(-1.0))) ** JOINTS)
