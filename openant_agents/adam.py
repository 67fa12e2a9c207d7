"""Adam (Kingma and Ba 2015) for weights that each are one vector: torch's fused step without the rest of `torch.optim`.

Whatever of `torch.optim` is called first loads torch's compiler, which takes as long as torch itself and is of no use here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

__all__ = ["Adam"]

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8
#: torch before 2.4 has the fused step on graphics cards only; it is none of what torch promises to keep
FUSED = hasattr(torch, "_fused_adam_") and tuple(int(part) for part in torch.__version__.split(".")[:2]) >= (2, 4)


class Adam:
    """Steps along the gradients in each weight's `grad`.

    Args:
        weights_and_steps: each weight with its step size.
    """

    def __init__(self, *weights_and_steps: tuple[Tensor, float]) -> None:
        self._weights = weights_and_steps
        self._means = [torch.zeros_like(weight, requires_grad=False) for weight, _ in weights_and_steps]
        self._squares = [torch.zeros_like(mean) for mean in self._means]
        self._counts = [torch.zeros((), device=mean.device) for mean in self._means]

    def step(self) -> None:
        """One step of every weight; call it where autograd does not look."""
        for (weight, size), mean, square, count in zip(
            self._weights, self._means, self._squares, self._counts, strict=True
        ):
            assert weight.grad is not None
            count += 1
            if not FUSED:
                mean.lerp_(weight.grad, 1 - BETA_1)
                square.mul_(BETA_2).addcmul_(weight.grad, weight.grad, value=1 - BETA_2)
                root = square.sqrt().div_(math.sqrt(1 - BETA_2 ** float(count))).add_(EPSILON)
                weight.addcdiv_(mean, root, value=-size / (1 - BETA_1 ** float(count)))
                continue
            torch._fused_adam_(
                [weight], [weight.grad], [mean], [square], [], [count],
                amsgrad=False, lr=size, beta1=BETA_1, beta2=BETA_2, weight_decay=0.0, eps=EPSILON, maximize=False,
            )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """As `torch.optim.Adam` keeps it, whose checkpoints go on, too."""
        kept = zip(self._counts, self._means, self._squares, strict=True)
        return {
            "state": {k: {"step": n, "exp_avg": m, "exp_avg_sq": v} for k, (n, m, v) in enumerate(kept)},
            "param_groups": [{"params": [k], "lr": size} for k, (_, size) in enumerate(self._weights)],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called; raises KeyError or ValueError where it is of other weights."""
        if len(state["param_groups"]) != len(self._weights):
            raise ValueError("it is of other weights")
        kept = state["state"]  # empty, where torch's had made no step yet
        for k, mean in enumerate(self._means):
            for name, tensor in (("step", self._counts[k]), ("exp_avg", mean), ("exp_avg_sq", self._squares[k])):
                new = kept[k][name] if kept else torch.zeros_like(tensor)
                if new.shape != tensor.shape:
                    there, here = (" × ".join(map(str, one.shape)) for one in (new, tensor))
                    raise ValueError(f"{name} has shape {there}, not {here}")
                tensor.copy_(new)
