"""SAC's derivatives written out, against those that autograd finds; and a single observation's way against a batch's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from openant_agents.by_hand import flatten  # noqa: E402
from openant_agents.sac import Sac, SacSettings  # noqa: E402

torch.set_num_threads(1)
SMALL = {"batch": 12, "hidden": 20, "buffer": 50}


def pair(seed: int, layer_norm: bool) -> tuple[Sac, Sac]:
    """Two agents alike, one by hand and one by autograd, with the same transitions."""
    chosen = SacSettings(layer_norm=layer_norm, **SMALL)
    agents = Sac(5, 3, chosen, seed=seed), Sac(5, 3, chosen, seed=seed, by_hand=False)
    random = np.random.default_rng(seed)
    rows = random.normal(size=(50, agents[0].replay.width)).astype(np.float32)
    rows[:, 8:11] = np.stack([rows[:, 8], np.full(50, 0.12), random.integers(0, 2, 50)], axis=1)
    weights = [
        torch.from_numpy(random.normal(size=one.shape).astype(np.float32)) for one in agents[0].actor.parameters()
    ]
    for agent in agents:
        agent.replay.restore(rows, 50)
        with torch.no_grad():  # no weight is where it happens to be at first: norms scale and shift, too
            for one, value in zip(agent.actor.parameters(), weights, strict=True):
                one.add_(0.2 * value)
    return agents


def gradients(module: torch.nn.Module) -> list[np.ndarray]:
    return [weight.grad.numpy().copy() for weight in module.parameters()]


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.booleans())
def test_every_derivative_is_autograds(seed, layer_norm):
    by_hand, by_torch = pair(seed, layer_norm)
    random = torch.Generator().manual_seed(seed)
    observation, noise = torch.randn(12, 5, generator=random), torch.randn(12, 3, generator=random)
    action, target = torch.rand(12, 3, generator=random) * 2 - 1, torch.randn(12, generator=random)
    alpha, found = torch.tensor(0.3), []
    for agent in (by_hand, by_torch):
        with torch.no_grad():
            one = agent._make_gradients()
            sampled, log_pi = (x.clone() for x in one.sample(observation, noise))
            value = one.value(observation, action).clone()
            loss = one.critics(torch.cat((observation, action), dim=1), target)
            of_critics = gradients(agent.critics)
            again = one.actor(observation, noise, alpha).clone()
        assert torch.equal(again, log_pi)
        assert all((a == b).all() for a, b in zip(of_critics, gradients(agent.critics), strict=True))
        everything = sampled, log_pi, value, loss, *of_critics, *gradients(agent.actor)
        found.append([np.asarray(one) for one in everything])
    for mine, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=3e-5 * max(1.0, float(np.abs(theirs).max())))


def test_updates_go_the_same_way_by_either():
    by_hand, by_torch = pair(3, layer_norm=True)
    for agent in (by_hand, by_torch):
        for _ in range(6):
            agent.update()
    assert by_hand.updates == by_torch.updates == 6
    # Adam makes steps of the same size of the smallest gradients, whose sign is rounding's.
    for mine, theirs in ((by_hand.critics, by_torch.critics), (by_hand.actor, by_torch.actor)):
        for one, other in zip(mine.parameters(), theirs.parameters(), strict=True):
            assert (one - other).abs().mean() < 1e-4
    assert by_hand.log_alpha.item() == pytest.approx(by_torch.log_alpha.item(), abs=1e-5)


@pytest.mark.parametrize("layer_norm", [True, False])
def test_one_observation_is_answered_as_a_batch_is(layer_norm):
    agent, _ = pair(1, layer_norm)
    observation = np.random.default_rng(1).normal(size=5).astype(np.float32)
    for _ in range(2):
        with torch.no_grad():
            expected = agent.actor.mode(torch.from_numpy(observation)[None])[0].numpy()
        np.testing.assert_allclose(agent.act(observation, explore=False), expected, atol=1e-6)
        state = agent.noise.get_state()
        mine = agent.act(observation)
        agent.noise.set_state(state)
        with torch.no_grad():
            expected = agent.actor(torch.from_numpy(observation)[None], agent._normal(1))[0][0].numpy()
        np.testing.assert_allclose(mine, expected, atol=1e-6)
        agent.update()  # acting sees weights as they are
        agent.update()


def test_weights_in_one_vector_stay_those_of_the_layers():
    network = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.LayerNorm(5), torch.nn.ReLU(), torch.nn.Linear(5, 1))
    before = [weight.detach().clone() for weight in network.parameters()]
    flat = flatten(network)
    assert all(torch.equal(a, b) for a, b in zip(before, network.parameters(), strict=True))
    assert all(weight.data_ptr() % 64 == flat.data_ptr() % 64 for weight in network.parameters())
    network(torch.ones(1, 3)).sum().backward()
    assert flat.grad.abs().sum() > 0
    with torch.no_grad():
        flat.add_(1.0)
    assert all(torch.allclose(a + 1.0, b) for a, b in zip(before, network.parameters(), strict=True))
    network.load_state_dict({name: torch.zeros_like(value) for name, value in network.state_dict().items()})
    assert float(flat[:15].detach().abs().sum()) == 0.0
