"""How the judge of the diagnosis tells causes apart where several act: templates that are taken out, and what is believed."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from openant_tools.gap.stack import PEELED, Stack, evidence
from openant_tools.gap.templates import Template, Templates

JOINTS, EACH = 3, 8
#: features of each cause at a joint: the first two are alike
LOOKS = {
    "late": np.array([1.0, 1, 1, 0, 0, 0, 0, 0]),
    "slow": np.array([1.0, 1, 0, 1, 0, 0, 0, 0]),
    "rough": np.array([0.0, 0, 0, 0, 1, 1, 1, 1]),
}


@pytest.fixture(scope="module")
def templates() -> Templates:
    bank: list[Template] = []
    vectors = []
    for cause, looks in LOOKS.items():
        for joint in range(JOINTS):
            for size in (1.0, 3.0):
                bank.append((cause, (joint,), {"x": size}))
                vectors.append(np.zeros((JOINTS, EACH)))
                vectors[-1][joint] = size * looks
    bank.append(("unseen", (0,), {"x": 1.0}))
    vectors.append(np.zeros((JOINTS, EACH)))
    return Templates.of(bank, np.array(vectors, np.float32).reshape(len(bank), -1), JOINTS)


def robot(templates: Templates, **causes: tuple[int, float]) -> np.ndarray:
    """(1, features) of a robot with causes at joints, so large."""
    z = np.zeros((1, JOINTS, EACH), np.float32)
    for cause, (joint, size) in causes.items():
        z[0, joint] += (size * LOOKS[cause]).astype(np.float32)
    return z.reshape(1, -1)


def test_templates_that_do_not_show_are_none(templates: Templates) -> None:
    assert templates.causes == ("late", "rough", "slow")


def test_the_best_places_come_first(templates: Templates) -> None:
    places = templates.places(templates.fits(robot(templates, rough=(2, 1.0)))[0])
    assert places["rough"][0] == ((2,), places["rough"][0][1])
    assert [where for where, _ in places["late"]] != []
    assert len(places["late"]) == JOINTS, "each place once"


def test_what_hides_behind_the_strongest_shows_once_that_is_taken_out(templates: Templates) -> None:
    z = robot(templates, late=(0, 10.0), rough=(1, 1.0))
    before = templates.by_cause(templates.fits(z))[0]
    late, rough, slow = (templates.causes.index(name) for name in ("late", "rough", "slow"))
    assert before[late] > before[slow] > before[rough], "its cousin hides the other one"
    (first, left), (second, rest) = templates.peeled(z, 2)
    assert first[0].argmax() == rough
    assert left[0, 0] == pytest.approx(2.0, rel=0.05)
    assert second[0].max() < 0.1 * first[0].max()
    assert rest[0, 0] < 0.25 * left[0, 0]


def test_what_a_judge_keeps_can_be_read_again(templates: Templates) -> None:
    templates.fits(robot(templates))
    again = pickle.loads(pickle.dumps(templates))
    assert again.bank == templates.bank
    assert np.array_equal(again.vectors, templates.vectors)


def test_a_second_cause_is_believed_though_nobody_who_sees_the_whole_robot_noticed(templates: Templates) -> None:
    """Who sees the whole robot is blinded by the first cause; who sees one joint at a time is not."""
    rng = np.random.default_rng(5)
    count, causes = 600, templates.causes
    labels = np.zeros((count, len(causes)), np.int64)
    z, whole = np.zeros((count, JOINTS * EACH), np.float32), np.full((count, len(causes)), -4.0)
    at_joints = {name: np.full((count, JOINTS), -4.0) for name in causes}
    for row in range(count):
        first, second = rng.choice(len(causes), 2, replace=False)
        for place, (cause, size, there) in enumerate(((first, 8.0, True), (second, 1.0, rng.random() < 0.5))):
            if not there:
                continue
            joint = int(rng.integers(JOINTS))
            labels[row, cause] = 1
            z[row] += robot(templates, **{causes[cause]: (joint, size)})[0]
            whole[row, cause] = 4.0 if place == 0 else -4.0
            at_joints[causes[cause]][row, joint] = 3.0
    z += rng.normal(0, 0.05, z.shape).astype(np.float32)
    told = evidence(templates, z, whole, at_joints)
    assert told.shape[:2] == labels.shape
    assert evidence(templates, z, whole, {}).shape[2] < told.shape[2], "a robot of few joints has nobody to look at one"
    half = count // 2
    said = Stack.taught(told[:half], labels[:half], 0)(told[half:])
    hidden = (labels[half:] == 1) & (whole[half:] < 0)
    assert said[hidden].mean() > 0.9
    assert said[labels[half:] == 0].mean() < 0.1
    assert PEELED >= 1
