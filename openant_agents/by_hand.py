"""SAC's gradients written out: what `sac.Sac.update` asks autograd for, without its book-keeping.

At a batch of 256 and layers of 256 autograd's recording of operations and the memory for what they return take a tenth of an
update. Here each network keeps its memory, and each derivative is one line of arithmetic; the numbers are autograd's but for
rounding (tests/agents/test_by_hand.py). On processors only: graphics cards have other troubles.

Acting is the same network for a single observation, compiled, on the very weights: a matrix times a vector takes less time
than torch needs to find out what it is to do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from openant_agents.compiled import compiled_sums

__all__ = ["Gradients", "Network", "acting", "flatten", "squashed"]

Array = NDArray[np.float32]

#: numbers to a cache line of 64 bytes: where each weight begins, so that matrices are read in whole lines
_LINE = 16


def flatten(module: nn.Module) -> Tensor:
    """Put all weights of a module, and their gradients, into one vector each: an optimiser then has one weight.

    Returns:
        The vector; the module's weights are views of it, their `grad` of its `grad`.
    """
    weights = list(module.parameters())
    starts = np.cumsum([0, *(-(-weight.numel() // _LINE) * _LINE for weight in weights)]).tolist()
    flat = torch.zeros(starts[-1], dtype=weights[0].dtype, device=weights[0].device)
    slopes = torch.zeros_like(flat)
    for weight, start in zip(weights, starts, strict=False):
        part = slice(start, start + weight.numel())
        flat[part] = weight.detach().reshape(-1)
        weight.data = flat[part].view_as(weight)
        weight.grad = slopes[part].view_as(weight)
    flat.requires_grad_(True)
    flat.grad = slopes
    return flat


class _Layer:
    """x → W x + b, then LayerNorm where there is one, then ReLU unless it is the last, with memory of what it saw."""

    def __init__(self, linear: nn.Linear, norm: nn.LayerNorm | None, rectified: bool, batch: int) -> None:
        self.linear, self.norm, self.rectified = linear, norm, rectified
        self.weight, self.bias = linear.weight.detach(), linear.bias.detach()
        self.sums = torch.empty(batch, linear.out_features)
        self.slopes = torch.empty(batch, linear.in_features)
        self.out = self.sums

    def forward(self, x: Tensor) -> Tensor:
        self.x = x
        torch.addmm(self.bias, x, self.weight.t(), out=self.sums)
        self.out = self.sums  # before the norm, whose last answer makes room for the next in the processor's memory
        if self.norm is not None:
            norm = self.norm
            self.out, self.mean, self.scale = torch.native_layer_norm(
                self.sums, list(norm.normalized_shape), norm.weight, norm.bias, norm.eps
            )
        return self.out.relu_() if self.rectified else self.out

    def backward(self, slope: Tensor, *, weights: bool, inputs: slice | None) -> Tensor:
        """From the loss' derivative by what came out to that by what came in, of the columns `inputs` of it.

        `slope` is overwritten. With `weights` those by weight and bias go into their `grad`.
        """
        if self.rectified:
            torch.ops.aten.threshold_backward.grad_input(slope, self.out, 0, grad_input=slope)
        if self.norm is not None:
            norm = self.norm
            slope, by_weight, by_bias = torch.ops.aten.native_layer_norm_backward(
                slope, self.sums, norm.normalized_shape, self.mean, self.scale, norm.weight, norm.bias,
                [True, weights, weights],
            )  # fmt: skip
            if weights:
                _grad(norm.weight).copy_(by_weight)
                _grad(norm.bias).copy_(by_bias)
        if weights:
            torch.mm(slope.t(), self.x, out=_grad(self.linear.weight))
            torch.sum(slope, 0, out=_grad(self.linear.bias))
        if inputs is None:
            return slope
        weight, out = self.weight[:, inputs], self.slopes[:, : inputs.stop - inputs.start]
        if slope.shape[1] == 1:  # an outer product, for which a matrix product takes twice as long
            return torch.mul(slope, weight, out=out)
        return torch.mm(slope, weight, out=out)


def _grad(weight: Tensor) -> Tensor:
    assert weight.grad is not None  # `flatten` gave it one
    return weight.grad


def _layers(network: nn.Sequential) -> Iterator[tuple[nn.Linear, nn.LayerNorm | None, bool]]:
    """Of each linear layer what follows it: a LayerNorm or none, and whether a ReLU."""
    parts = list(network)
    for at, part in enumerate(parts):
        if isinstance(part, nn.Linear):
            rest = parts[at + 1 : at + 3]
            norm = rest[0] if rest and isinstance(rest[0], nn.LayerNorm) else None
            yield part, norm, bool(rest)


class Network:
    """Forward and backward through linear layers, each with LayerNorm or without, and ReLU between them.

    Args:
        network: whose weights are used, and have their gradients in `grad` (`flatten`).
        batch: rows of every input.
    """

    def __init__(self, network: nn.Sequential, batch: int) -> None:
        self._layers = [_Layer(*parts, batch) for parts in _layers(network)]

    def forward(self, x: Tensor) -> Tensor:
        """(batch, outputs) of (batch, inputs); the memory is reused by the next call."""
        for layer in self._layers:
            x = layer.forward(x)
        return x

    def backward(self, slope: Tensor, *, weights: bool = True, inputs: slice | None = None) -> Tensor:
        """Through what the last `forward` saw.

        Args:
            slope: (batch, outputs), the loss' derivative by the output; overwritten.
            weights: whether the derivatives by weights are wanted. inputs: those by which columns of the input.

        Returns:
            (batch, inputs), where wanted.
        """
        for layer in reversed(self._layers[1:]):
            slope = layer.backward(slope, weights=weights, inputs=slice(0, layer.linear.in_features))
        return self._layers[0].backward(slope, weights=weights, inputs=inputs)


class Gradients:
    """Of the losses of SAC, by the weights of its critics and its actor.

    Args:
        actor: from observations to mean and spread of each action. critics, targets: the two networks of each.
        batch: transitions in an update. observations: how many numbers an observation has.
        log_std: lowest and highest logarithm of a standard deviation, between which tanh of the spread goes.
    """

    def __init__(
        self,
        actor: nn.Sequential,
        critics: Iterable[nn.Sequential],
        targets: Iterable[nn.Sequential],
        *,
        batch: int,
        observations: int,
        log_std: tuple[float, float],
    ) -> None:
        self._actor = Network(actor, batch)
        self._critics = [Network(one, batch) for one in critics]
        self._targets = [Network(one, batch) for one in targets]
        self._batch, self._observations = batch, observations
        self._low, self._half = log_std[0], 0.5 * (log_std[1] - log_std[0])
        self._pairs: Tensor | None = None  # rows of observation and action

    def sample(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (batch, actions) and their log π (batch,), as `sac.Actor` samples them."""
        mean, spread = self._actor.forward(observation).chunk(2, dim=1)
        self._spread = torch.tanh(spread)
        log_std = self._low + self._half * (self._spread + 1.0)
        self._kick = log_std.exp().mul_(noise)
        u = mean + self._kick
        # Of the Gaussian, less log(1 − tanh²u) = 2 (log 2 − u − softplus(−2u)); what is the same everywhere comes last.
        log_pi = torch.addcmul(u + F.softplus(-2.0 * u), noise, noise, value=-0.25).mul_(2.0).sub_(log_std).sum(1)
        self._action = torch.tanh(u)
        return self._action, log_pi.sub_(noise.shape[1] * (0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0)))

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """(batch,), the smaller of the targets' values."""
        pairs = self._paired(observation, action)
        first, second = (one.forward(pairs) for one in self._targets)
        return torch.minimum(first, second).squeeze(1)

    def critics(self, observation_action: Tensor, target: Tensor) -> Tensor:
        """Gradients of the mean squared errors of both critics; their sum."""
        total = torch.zeros(())
        for one in self._critics:
            by = one.forward(observation_action).squeeze(1) - target
            total += torch.dot(by, by)
            one.backward((by * (2.0 / self._batch)).unsqueeze(1))
        return total / self._batch

    def actor(self, observation: Tensor, noise: Tensor, alpha: Tensor) -> Tensor:
        """Gradients of the mean of α log π − min Q; log π (batch,)."""
        action, log_pi = self.sample(observation, noise)
        pairs = self._paired(observation, action)
        first, second = (one.forward(pairs) for one in self._critics)
        smaller = (first <= second).to(first.dtype) / -self._batch
        columns = slice(self._observations, pairs.shape[1])
        by_action = self._critics[0].backward(smaller, weights=False, inputs=columns)
        by_action = by_action + self._critics[1].backward(
            -1.0 / self._batch - smaller, weights=False, inputs=columns
        )  # fmt: skip
        # log π holds −log(1 − tanh²u), whose derivative is 2 tanh u, and −log σ.
        weight = alpha / self._batch
        by_u = torch.addcmul(by_action, by_action, action * action, value=-1.0).addcmul_(action, 2.0 * weight)
        by_log_std = torch.addcmul(-weight, by_u, self._kick)
        by_spread = torch.addcmul(by_log_std, by_log_std, self._spread * self._spread, value=-1.0).mul_(self._half)
        self._actor.backward(torch.cat((by_u, by_spread), dim=1))
        return log_pi

    def _paired(self, observation: Tensor, action: Tensor) -> Tensor:
        if self._pairs is None:
            self._pairs = torch.empty(self._batch, self._observations + action.shape[1])
        self._pairs[:, : self._observations] = observation
        self._pairs[:, self._observations :] = action
        return self._pairs


@compiled_sums
def _forward(
    weight: Array, bias: Array, scale: Array, shift: Array, least: float, rectified: bool, x: Array, out: Array
) -> None:
    """`_Layer.forward` for one row, into `out`; without a norm `scale` is empty."""
    rows, columns = weight.shape
    for i in range(rows):
        total = bias[i]
        for j in range(columns):
            total += weight[i, j] * x[j]
        out[i] = total
    if scale.size:
        mean = np.float32(0.0)
        for i in range(rows):
            mean += out[i]
        mean /= np.float32(rows)
        squares = np.float32(0.0)
        for i in range(rows):
            out[i] -= mean
            squares += out[i] * out[i]
        by = np.float32(1.0 / math.sqrt(squares / rows + least))
        for i in range(rows):
            out[i] = out[i] * by * scale[i] + shift[i]
    if rectified:
        for i in range(rows):
            out[i] = max(out[i], np.float32(0.0))


def acting(network: nn.Sequential) -> Callable[[Array], Array]:
    """The network for a single observation: (outputs,) from (inputs,), on the weights as they are at each call.

    What it returns is overwritten by the next call.
    """
    none = np.empty(0, np.float32)
    layers = [
        (
            linear.weight.detach().numpy(),
            linear.bias.detach().numpy(),
            *(
                (none, none, 0.0)
                if norm is None
                else (norm.weight.detach().numpy(), norm.bias.detach().numpy(), norm.eps)
            ),
            rectified,
            np.empty(linear.out_features, np.float32),
        )
        for linear, norm, rectified in _layers(network)
    ]

    def forward(x: Array) -> Array:
        for weight, bias, scale, shift, least, rectified, out in layers:
            _forward(weight, bias, scale, shift, least, rectified, x, out)
            x = out
        return x

    return forward


@compiled_sums
def squashed(thought: Array, noise: Array, low: float, high: float) -> Array:
    """(actions,) in −1…1: what the policy's mean and spread (2 × actions,) make of standard normal noise (actions,).

    Args:
        low, high: ends of log σ.
    """
    actions = len(noise)
    action = np.empty_like(noise)
    for i in range(actions):
        log_std = low + 0.5 * (high - low) * (math.tanh(thought[actions + i]) + 1.0)
        action[i] = math.tanh(thought[i] + math.exp(log_std) * noise[i])
    return action
