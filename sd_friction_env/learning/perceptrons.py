"""Multilayer perceptrons with their gradient written out: for networks this small, PyTorch's modules, autograd and
tanh take most of the time of training. On the CPU only.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn


class Adam:
    """Adam (Kingma and Ba, 2015) on all parameters of a module as one array, in place of ``torch.optim.Adam``.

    The parameters and their ``grad`` become views of :attr:`values` and :attr:`gradient`, shape (n,), float32.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, eps: float = 1e-5) -> None:
        parameters = list(parameters)
        self.values = torch.cat([part.detach().flatten() for part in parameters])
        self.gradient, self.mean, self.square = (torch.empty_like(self.values) for _ in range(3))
        self.param_groups: list[dict[str, Any]] = [{"lr": lr, "eps": eps, "betas": (0.9, 0.999)}]
        self.reset()
        end = 0
        for part in parameters:
            begin, end = end, end + part.numel()
            part.data, part.grad = (whole[begin:end].view(part.shape) for whole in (self.values, self.gradient))

    def reset(self) -> None:
        """Forget all gradients."""
        for part in (self.gradient, self.mean, self.square):
            part.zero_()
        self.steps = 0

    def step(self, max_norm: float = float("inf")) -> None:
        """Descend along the gradient, after scaling it to at most a norm."""
        self.gradient *= min(1.0, max_norm / (float(torch.linalg.vector_norm(self.gradient)) + 1e-6))
        lr, eps, (keep, keep_square) = (self.param_groups[0][name] for name in ("lr", "eps", "betas"))
        self.steps += 1
        self.mean.lerp_(self.gradient, 1.0 - keep)
        self.square.mul_(keep_square).addcmul_(self.gradient, self.gradient, value=1.0 - keep_square)
        scale = (self.square / (1.0 - keep_square**self.steps)).sqrt_().add_(eps)
        self.values.addcdiv_(self.mean, scale, value=-lr / (1.0 - keep**self.steps))

    def state_dict(self) -> dict[str, Any]:
        """Return the state as tensors (not copied) and plain values."""
        return {"mean": self.mean, "square": self.square, "steps": self.steps, "param_groups": self.param_groups}

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.mean.copy_(state["mean"])
        self.square.copy_(state["square"])
        self.steps, self.param_groups = state["steps"], [dict(group) for group in state["param_groups"]]


class Perceptron:
    """Linear layers with Tanh or ReLU between them, on the memory of modules whose optimiser is :class:`Adam`."""

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        self.layers: list[Any] = list(modules[::2])
        self.is_tanh = isinstance(modules[1], nn.Tanh) if len(modules) > 1 else True

    @torch.no_grad()
    def forward(self, inputs: Tensor) -> list[Tensor]:
        """Return the inputs (n, inputs) of the first layer, of each further one, and the output (n, outputs)."""
        values = [inputs]
        for layer in self.layers:
            values.append(torch.addmm(layer.bias, values[-1], layer.weight.t()))
            if layer is self.layers[-1]:
                break
            if self.is_tanh:
                np.tanh(values[-1].numpy(), out=values[-1].numpy())  # several times faster than PyTorch's
            else:
                values[-1].relu_()
        return values

    @torch.no_grad()
    def backward(self, values: Sequence[Tensor], slope: Tensor) -> None:
        """Write the gradient of a loss into the modules.

        Args:
            values: what :meth:`forward` returned. slope: of the loss by the output, shape (n, outputs).
        """
        for layer, seen in zip(reversed(self.layers), reversed(values[:-1]), strict=True):
            torch.mm(slope.t(), seen, out=layer.weight.grad)
            torch.sum(slope, 0, out=layer.bias.grad)
            if layer is not self.layers[0]:
                slope = torch.mm(slope, layer.weight)
                slope *= torch.addcmul(torch.ones(()), seen, seen, value=-1.0) if self.is_tanh else seen > 0.0
