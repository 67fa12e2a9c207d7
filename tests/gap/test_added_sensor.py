"""A sensor that is added makes no verdict worse: robots that were judged with what servos say of torque, and without."""

from __future__ import annotations

import json
import sys

from places import ROOT
from scipy.stats import binomtest

from openant_tools.gap.decide import OUTSIDE, decide
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED

TRAINING = ROOT / "benchmarks/gap_training"


def test_a_current_that_is_logged_hurts_nothing() -> None:
    """By a sign test of those robots alone whose verdict is another one."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.gap_training.decision import Judged, judged
    from benchmarks.gap_training.sensors import without

    def right(one: Judged) -> bool:
        verdict = decide(one.rows, one.anomaly).verdict
        return verdict in ({NONE, AMBIGUOUS, UNEXPLAINED} if OUTSIDE in one.right else one.right)

    pairs = []
    for path in sorted((TRAINING / "without_current").glob("*.json")):
        (robots,) = (judged(place) for place in TRAINING.glob(f"*/{path.name}") if place != path)
        kept = json.loads(path.read_text())
        pairs += [(robots[int(n)], without(robots[int(n)], one)) for n, one in kept.items() if one is not None]
    assert len(pairs) >= 60
    both = [(right(with_it), right(without_it), with_it) for with_it, without_it in pairs]
    for group in (
        lambda one: True,
        lambda one: one.ill,
        lambda one: NONE in one.right,
        lambda one: OUTSIDE in one.right,
    ):
        mine = [(with_it, without_it) for with_it, without_it, one in both if group(one)]
        worse, better = mine.count((False, True)), mine.count((True, False))
        if worse:
            assert binomtest(worse, worse + better, alternative="greater").pvalue > 0.05
