"""Sizes of causes lie where they are said to lie: on robots that did not teach it, of two makers; and what makes that narrower."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.size_interval import Known, ends, spreads

sys.path.insert(0, str(ROOT))
from benchmarks.gap_training.sizes import inside, kept, learned

SETS = kept(ROOT / "benchmarks/gap_training/sizes.json")


@pytest.mark.parametrize("maker", ["batch", "drake"])
def test_ends_hold_on_robots_of_a_maker_that_did_not_teach_them(maker: str) -> None:
    others = [one for name, some in SETS.items() if not name.startswith(maker) for one in some]
    theirs = [one for name, some in SETS.items() if name.startswith(maker) for one in some]
    found = inside(theirs, learned(others))
    assert len(found) > 25
    assert sum(found) / len(found) > 0.85, f"{sum(found)} of {len(found)}"


def test_what_is_shipped_is_what_the_kept_robots_teach() -> None:
    taught = learned([one for some in SETS.values() for one in some])
    assert dict(spreads()) == pytest.approx(taught, rel=1e-3)


SIZES = [q for effect in catalogue().values() for q in effect.quantities if not q.shape]


@given(st.sampled_from(SIZES), st.floats(0.1, 1.5), st.floats(0, 4), st.floats(0, 0.5), st.booleans())
def test_a_size_lies_between_its_ends_and_is_known_the_better_the_less_tolerances_do_alike(
    q: object, way: float, support: float, std: float, negative: bool
) -> None:
    assert q in SIZES
    quantity = SIZES[SIZES.index(q)]
    x = way * quantity.large * (-1 if negative and quantity.signed else 1)
    known = Known(x, abs(x), std * abs(x), 0.0, support)
    low, high = ends(quantity, known)
    assert low <= x <= high
    surer, looser = (
        ends(quantity, replace(known, support=support + 1)),
        ends(quantity, replace(known, tolerance=abs(x))),
    )
    assert high - low > surer[1] - surer[0]
    assert looser[1] - looser[0] > high - low
    assert quantity.signed or low > 0


def test_a_small_part_of_a_cause_is_known_no_better_than_its_largest() -> None:
    effect = catalogue()["cable_drag"]
    x = {"force_x_n": 0.1, "force_y_n": 0.0, "damping_n_s_m": 0.001}
    low, high = ends(
        effect.quantity("damping_n_s_m"),
        Known.of(effect.quantity("damping_n_s_m"), x, effect.quantities, 0.0, 0.0, 8.0, 8),
    )
    assert high > 0.1
    assert low < 0.001
    assert math.isfinite(high)
