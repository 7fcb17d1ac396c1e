"""The network: strips, each by the same convolutions along time, pooled; then convolutions along the column."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rxcli.receiver.channel.denoise import N_COLUMN_FEATURES, N_STRIP_FEATURES


@dataclass(frozen=True)
class Shape:
    """Size of a network; what a checkpoint needs to be read back."""

    #: Channels of a strip and of a column.
    strip_width: int = 32
    column_width: int = 48
    #: Dilations of the strip's and of the column's convolutions, in slots.
    strip_dilations: tuple[int, ...] = (1, 2, 4)
    column_dilations: tuple[int, ...] = (1, 2, 4, 8)


class _Residual(nn.Module):  # type: ignore[misc]
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + torch.relu(self.conv(x))


class StripNetwork(nn.Module):  # type: ignore[misc]
    """Corrections of slots from the features of `channel.denoise.network_inputs`; any number of strips and slots."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        wide, tall = shape.strip_width, shape.column_width
        self.strip_in = nn.Conv1d(N_STRIP_FEATURES, wide, 3, padding=1)
        self.strip = nn.Sequential(*(_Residual(wide, d) for d in shape.strip_dilations))
        self.gate = nn.Conv1d(wide, wide, 1)
        self.column_in = nn.Conv1d(2 * wide + N_COLUMN_FEATURES, tall, 3, padding=1)
        self.column = nn.Sequential(*(_Residual(tall, d) for d in shape.column_dilations))
        self.out = nn.Conv1d(tall, 1, 1)
        # Before it has learned anything the network corrects nothing.
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, strips: Tensor, columns: Tensor) -> Tensor:
        """(B, S, F, N) and (B, G, N) to (B, N) corrections."""
        batch, n_strips, _, n_slots = strips.shape
        x = torch.relu(self.strip_in(strips.reshape(batch * n_strips, N_STRIP_FEATURES, n_slots)))
        x = self.strip(x)
        gate = torch.sigmoid(self.gate(x)).reshape(batch, n_strips, -1, n_slots)
        x = x.reshape(batch, n_strips, -1, n_slots)
        # Strips add up like independent observations; the mean of the open ones tells what they agree on.
        total = (gate * x).sum(dim=1)
        mean = total / (gate.sum(dim=1) + 0.1)
        y = torch.relu(self.column_in(torch.cat([total * 0.2, mean, columns], dim=1)))
        return self.out(self.column(y)).squeeze(1)


def n_parameters(network: nn.Module) -> int:
    """Weights of a network."""
    return sum(p.numel() for p in network.parameters())
