"""What evidence makes a verdict: told to it by hand, since the simulations that give it are tested elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from openant_tools.gap.cause import catalogue
from openant_tools.gap.closure import ClosureByJoint, Refit
from openant_tools.gap.explain import Explained, Part
from openant_tools.gap.judge import Judgement
from openant_tools.gap.verdict import _Evidence, _told_apart


def evidence(**suspects: tuple[float, float]) -> _Evidence:
    """Suspects with their probability and the share of the gap that each closes by itself."""
    nothing: Any = None

    def closure(closed: float) -> ClosureByJoint:
        joints = np.array([[1.0], [(1 - closed) ** 2]])
        return ClosureByJoint(1 - closed, closed, closed, closed, closed, Refit((), (), np.zeros(0)), joints, 0.0)

    return _Evidence(
        nothing, Judgement({}, 5.0, {}), {}, nothing, [], {name: chance for name, (chance, _) in suspects.items()},
        {name: Explained(Part(name, (0,)), {}, {}, 1.0) for name in suspects},
        {name: closure(closed) for name, (_, closed) in suspects.items()}, closure(0.1), 1.0, 0.0, [0],
    )  # fmt: skip


@pytest.mark.parametrize("likelier", [0.66, 0.06])
def test_of_causes_that_look_alike_the_one_that_closes_more_is_believed(likelier: float) -> None:
    found = evidence(foot_adhesion=(0.66, 0.72), floor_friction=(0.06, 0.75))
    _told_apart(found)
    assert found.names[0] == "floor_friction"
    assert found.probability == {"foot_adhesion": 0.06, "floor_friction": 0.66}
    found = evidence(foot_adhesion=(likelier, 0.86), floor_friction=(0.72 - likelier, 0.76))
    _told_apart(found)
    assert found.names[0] == "foot_adhesion"
    assert found.probability["foot_adhesion"] == pytest.approx(0.66)


@pytest.mark.parametrize(
    ("adhesion", "friction"),
    [((0.9, 0.2), (0.1, 0.3)), ((0.9, 0.80), (0.1, 0.805))],
    ids=["neither closes much", "they close as much"],
)
def test_where_windows_do_not_tell_them_apart_the_judge_does(
    adhesion: tuple[float, float], friction: tuple[float, float]
) -> None:
    found = evidence(foot_adhesion=adhesion, floor_friction=friction)
    _told_apart(found)
    assert found.probability == {"foot_adhesion": 0.9, "floor_friction": 0.1}


def test_what_looks_unlike_keeps_what_the_judge_gave_it() -> None:
    found = evidence(foot_adhesion=(0.9, 0.5), payload=(0.1, 0.9))
    _told_apart(found)
    assert found.probability == {"foot_adhesion": 0.9, "payload": 0.1}


def test_looking_alike_is_mutual() -> None:
    for name, cause in catalogue().items():
        assert all(name in catalogue()[twin].alike for twin in cause.alike)
