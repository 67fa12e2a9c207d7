"""The decision is a pure function of rows and costs: who leads, and who cannot."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from openant_tools.gap.decide import Row, decide

NOTHING = Row((), probability=0.05)
LAG = Row(("actuator_lag",), ((0,),), 0.85, gain=0.5, error=0.02, expected=0.6)
DELAY = Row(("action_delay",), ((0,),), 0.06, gain=0.45, error=0.02, expected=0.6)


def test_what_evidence_and_held_out_data_speak_for_leads() -> None:
    found = decide([NOTHING, LAG, DELAY], outside=0.04)
    assert found.verdict == "actuator_lag"
    assert found.selected == (LAG,)
    assert found.confidence > 0.8


def test_nothing_known_shares_what_held_out_data_refute() -> None:
    worse = replace(LAG, gain=-0.3, error=0.05)
    assert worse.refuted
    assert decide([NOTHING, worse, DELAY], outside=0.04).verdict == "unexplained"
    silent = replace(LAG, gain=0.0, error=0.02)  # it should show, and shows nothing
    assert silent.refuted


def test_where_its_gain_would_lie_below_the_noise_held_out_data_are_no_evidence() -> None:
    unseen = replace(LAG, gain=0.0, error=0.2, expected=0.3)  # a stop where the held-out motion never goes
    assert not unseen.refuted
    assert decide([NOTHING, unseen], outside=0.04).verdict == "actuator_lag"


def test_two_that_share_what_is_likely_are_ambiguous() -> None:
    found = decide([NOTHING, replace(LAG, probability=0.45), replace(DELAY, probability=0.45)], outside=0.05)
    assert found.verdict == "ambiguous"
    assert set(found.alike[0]) == {"actuator_lag", "action_delay"}
    assert found.selected == ()


def test_a_cause_is_not_open_against_itself_with_another_beside_it() -> None:
    alone = replace(LAG, probability=0.45)
    both = replace(alone, causes=("actuator_lag", "backlash"), joints=((0,), (0,)), gain=0.52)
    found = decide([NOTHING, alone, both], outside=0.05)
    assert found.verdict == "actuator_lag"
    assert found.selected == (both,), "the likelier of the two"


def test_gains_that_are_the_same_in_every_fold_are_no_fault() -> None:
    sure = replace(LAG, error=0.0)
    assert decide([NOTHING, sure], outside=0.05).verdict == "actuator_lag"


def test_a_healthy_robot_has_nothing() -> None:
    rows = [
        replace(NOTHING, probability=0.9),
        replace(LAG, probability=0.05, gain=0.01),
        replace(DELAY, probability=0.02, gain=0.0),
    ]
    found = decide(rows, outside=0.03)
    assert (found.verdict, found.selected) == ("none", ())


@given(st.lists(st.floats(0.001, 1.0), min_size=3, max_size=6), st.randoms())
def test_the_order_of_rows_and_what_is_left_out_of_a_whole_change_nothing(
    shares: list[float], chance: st.DataObject
) -> None:
    none, outside, *causes = shares
    rows = [Row((), probability=none)] + [Row((f"c{k}",), ((0,),), p) for k, p in enumerate(sorted(set(causes)))]
    first = decide(rows, outside)
    chance.shuffle(rows)  # type: ignore[attr-defined]
    assert decide(rows, outside) == first
    assert 0.0 <= first.confidence <= 1.0
    half = [replace(row, probability=row.probability / 2) for row in rows]
    assert decide(half, outside / 2).verdict == first.verdict
